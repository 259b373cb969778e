"""The master's view of any fieldbus: the device's description, the link, and the errors."""
