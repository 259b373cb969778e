"""Does any path lead to a motor that runs on? A model of program, envelope, bus and drive, explored to its end."""
