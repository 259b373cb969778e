"""Scripts that made the shipped data: fits, trainings, comparisons."""
