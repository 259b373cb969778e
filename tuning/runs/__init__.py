"""Runs of many points: sweeps, pools of workers, and their files."""
