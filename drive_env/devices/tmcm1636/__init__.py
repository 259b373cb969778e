"""Trinamic TMCM-1636: one BLDC or DC servo axis on CAN (firmware manual V1.09, document V1.01)."""
