"""Training, evaluation and all that touches the command line, loggers, files and plots."""
