"""The commands of `drive-agent`: one file each, with the function that the command line registers."""
