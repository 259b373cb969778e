"""Driven loads: MuJoCo models with rows of data, friction, and many copies stepped as one model."""

from mechanics.load import Contact, Friction, Load, Parameter, Roll, Switch

__all__ = ["Contact", "Friction", "Load", "Parameter", "Roll", "Switch"]
