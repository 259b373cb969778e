"""TGZ-D: servo amplifier of two axes on one DC link, CANopen and EtherCAT (page "Object library" of its manual)."""
