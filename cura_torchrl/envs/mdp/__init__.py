"""The task itself as pure batched tensor functions, free of any simulator."""
