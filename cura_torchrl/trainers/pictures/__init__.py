"""What happened in an episode or in a training, as pictures, animations and curves."""
