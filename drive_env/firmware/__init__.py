"""What runs inside the drive: the record, and one file per stage of the cycle."""
