"""The commands of `drive-env`: one file each, with the function that the command line registers."""
