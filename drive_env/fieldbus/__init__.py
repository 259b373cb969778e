"""What every fieldbus is to those who command drives: the device as it is known there, the link, and what can fail."""
