"""Run a function of one grasp over a batch: lanes and tiles, what crosses them, and how it is differentiated."""
