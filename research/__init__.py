"""Scripts that made what ships: fits, trainings, comparisons."""
