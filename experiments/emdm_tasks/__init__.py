"""What `emdm.py` does for each task: data, scores, and samples to look at."""
