"""A drive as an FMU: for tools that simulate a machine and import what turns it by FMI."""
