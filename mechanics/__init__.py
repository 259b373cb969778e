"""Driven loads: MuJoCo models with rows of data, friction, and many copies stepped as one model."""
