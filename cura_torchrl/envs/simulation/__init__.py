"""The simulators, and the batched state they return."""
