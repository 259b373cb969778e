"""Trinamic TMCM-6212: six stepper axes on one CAN node (firmware manual V3.24, document V1.07)."""
