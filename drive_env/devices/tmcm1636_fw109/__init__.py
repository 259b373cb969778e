"""The TMCM-1636 as its maker's EDS of firmware 1.09 has it: `device.toml` has the differences."""
