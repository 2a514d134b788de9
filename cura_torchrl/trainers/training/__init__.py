"""What training needs beside its loop: learner, rollouts on several machines, run folders, progress."""
