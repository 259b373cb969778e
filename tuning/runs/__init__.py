"""Runs of many points: sweeps, pools of workers, and the files that they leave."""
