"""The commands of `drive-tune`: one file each, with the function that the command line registers."""
