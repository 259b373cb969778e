"""Trinamic TMCM-3313: three stepper axes on one node of EtherCAT (CoE firmware manual V1.09, document V1.08)."""
