"""A drive as an FMU: for simulation tools that import it by FMI."""
