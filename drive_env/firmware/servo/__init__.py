"""The stages of servo drives for PMSMs and DC motors: sensors, start-up, loops, power stage, winding, temperatures."""
