"""What is played, how it is measured and kept, and the table that is made of it."""
