"""The TGZ-S: a TGZ-D whose second axis is not there."""
