"""The link over CAN: frames, SDO, NMT, PDOs, SYNC, error control."""
