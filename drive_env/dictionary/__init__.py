"""The object dictionary: its entries, the checks on access, units and bindings to the drive record."""
