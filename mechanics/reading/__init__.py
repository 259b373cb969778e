"""Files that anybody may have written: readers with limits, a process with limits, and names that were meant."""
