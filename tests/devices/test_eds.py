"""The TMCM-1636's object dictionary, row by row from its manual, against the EDS as python-canopen reads it."""

from __future__ import annotations

import configparser

import canopen
from canopen.objectdictionary import ODArray, ODRecord, ODVariable, datatypes
from rigs import ROOT
from rigs.tables import every_row

EDS = ROOT / "drive_env" / "devices" / "tmcm1636" / "tmcm1636.eds"
NODE = 5

U8, U16, U32 = "UNSIGNED8", "UNSIGNED16", "UNSIGNED32"
I8, I16, I32 = "INTEGER8", "INTEGER16", "INTEGER32"
STRING = "VISIBLE_STRING"

BYTE, WORD, DWORD = 0xFF, 0xFFFF, 0xFFFF_FFFF
LOW16, HIGH16 = -32768, 32767
LOW32, HIGH32 = -2147483648, 2147483647

# Records and arrays: index, name, kind.
GROUPS = [
    (0x1010, "Store parameters", ODArray),
    (0x1011, "Restore default parameters", ODArray),
    (0x1016, "Consumer heartbeat time", ODArray),
    (0x1018, "Identity object", ODRecord),
    (0x1029, "Error behavior", ODArray),
    (0x1400, "RPDO 1 communication parameter", ODRecord),
    (0x1401, "RPDO 2 communication parameter", ODRecord),
    (0x1402, "RPDO 3 communication parameter", ODRecord),
    (0x1403, "RPDO 4 communication parameter", ODRecord),
    (0x1600, "RPDO 1 mapping parameter", ODRecord),
    (0x1601, "RPDO 2 mapping parameter", ODRecord),
    (0x1602, "RPDO 3 mapping parameter", ODRecord),
    (0x1603, "RPDO 4 mapping parameter", ODRecord),
    (0x1800, "TPDO 1 communication parameter", ODRecord),
    (0x1801, "TPDO 2 communication parameter", ODRecord),
    (0x1802, "TPDO 3 communication parameter", ODRecord),
    (0x1803, "TPDO 4 communication parameter", ODRecord),
    (0x1A00, "TPDO 1 mapping parameter", ODRecord),
    (0x1A01, "TPDO 2 mapping parameter", ODRecord),
    (0x1A02, "TPDO 3 mapping parameter", ODRecord),
    (0x1A03, "TPDO 4 mapping parameter", ODRecord),
    (0x2000, "Device Info", ODRecord),
    (0x2006, "Brake Chopper", ODRecord),
    (0x2041, "Torque Mode Settings", ODRecord),
    (0x2042, "Velocity Mode Settings", ODRecord),
    (0x2043, "Position Mode Settings", ODRecord),
    (0x2060, "ADC Configuration", ODRecord),
    (0x2070, "Hall Sensor Settings", ODRecord),
    (0x2080, "ABN Encoder Settings", ODRecord),
    (0x2703, "Digital Outputs", ODArray),
    (0x270E, "Analog Inputs", ODRecord),
    (0x607D, "Software position limit", ODArray),
    (0x6099, "Homing speeds", ODArray),
    (0x60C2, "Interpolation time period", ODRecord),
]

# Entries: index, sub-index, name, type, access, low, high, default, unit, PDO mappable, table of the manual.
# Sub-index 0 where the manual omits it is CiA 301's.
ENTRIES = [
    # Section 3, communication area
    (0x1000, 0, "Device type", U32, "ro", 0, DWORD, 0xFFFC0192, "", 0, 6),
    (0x1001, 0, "Error register", U8, "ro", 0, BYTE, 0, "", 0, 8),
    (0x1005, 0, "COB-ID SYNC message", U32, "rw", None, None, 0x80, "", 0, 12),
    (0x1008, 0, "Manufacturer device name", STRING, "ro", None, None, "TMCM-1636", "", 0, 14),
    (0x1009, 0, "Manufacturer hardware version", STRING, "ro", None, None, "1.0", "", 0, 16),
    (0x100A, 0, "Manufacturer software version", STRING, "ro", None, None, "1.09", "", 0, 18),
    (0x100C, 0, "Guard time", U16, "rw", 0, WORD, 0, "ms", 0, 20),
    (0x100D, 0, "Life time factor", U8, "rw", 0, BYTE, 0, "", 0, 22),
    (0x1010, 0, "Highest sub-index supported", U8, "ro", 0, BYTE, 4, "", 0, 25),
    (0x1010, 1, "Save all parameters", U32, "rw", None, None, 1, "", 0, 25),  # reads 1: can be stored
    (0x1010, 2, "Save communication parameters", U32, "rw", None, None, 1, "", 0, 25),
    (0x1010, 3, "Save device profile parameters", U32, "rw", None, None, 1, "", 0, 25),
    (0x1010, 4, "Save motor axis 0 parameters", U32, "rw", None, None, 1, "", 0, 25),
    (0x1011, 0, "Highest sub-index supported", U8, "ro", 0, BYTE, 4, "", 0, 28),
    (0x1011, 1, "Restore all parameters", U32, "rw", None, None, 1, "", 0, 28),  # reads 1: can be restored
    (0x1011, 2, "Restore communication parameters", U32, "rw", None, None, 1, "", 0, 28),
    (0x1011, 3, "Restore device profile parameters", U32, "rw", None, None, 1, "", 0, 28),
    (0x1011, 4, "Restore motor axis 0 parameters", U32, "rw", None, None, 1, "", 0, 28),
    (0x1014, 0, "COB-ID EMCY", U32, "rw", None, None, 0x80 + NODE, "", 0, 30),
    (0x1015, 0, "Inhibit time EMCY", U16, "rw", 0, WORD, 0, "100us", 0, 32),  # table 31's name is a slip
    (0x1016, 0, "Number of entries", U8, "ro", 0, BYTE, 1, "", 0, 35),
    (0x1016, 1, "Consumer heartbeat time 1", U32, "rw", 0, DWORD, 0, "", 0, 35),
    (0x1017, 0, "Producer heartbeat time", U16, "rw", 0, WORD, 0, "ms", 0, 37),
    (0x1018, 0, "Number of entries", U8, "ro", 0, 3, 3, "", 0, 39),
    (0x1018, 1, "Vendor ID", U32, "ro", 0, DWORD, 0x286, "", 0, 39),
    (0x1018, 2, "Product code", U32, "ro", 0, DWORD, 1636, "", 0, 39),
    (0x1018, 3, "Revision number", U32, "ro", 0, DWORD, 0x0001_0009, "", 0, 39),  # V1.09
    (0x1029, 0, "Number of error classes", U8, "ro", 0, BYTE, 2, "", 0, 41),
    (0x1029, 1, "Communication error", U8, "rw", 0, 2, 0, "", 0, 41),
    (0x1029, 2, "Application error", U8, "rw", 0, 2, 1, "", 0, 41),
    # PDO COB-IDs: bit 30 is always set (3.1.17)
    (0x1400, 0, "Largest sub-index supported", U8, "ro", 2, 2, 2, "", 0, 43),
    (0x1400, 1, "COB-ID used by PDO", U32, "rw", None, None, 0x4000_0200 + NODE, "", 0, 43),
    (0x1400, 2, "Transmission type", U8, "rw", 0, BYTE, 0xFF, "", 0, 43),
    (0x1401, 0, "Largest sub-index supported", U8, "ro", 2, 2, 2, "", 0, 43),
    (0x1401, 1, "COB-ID used by PDO", U32, "rw", None, None, 0x4000_0300 + NODE, "", 0, 43),
    (0x1401, 2, "Transmission type", U8, "rw", 0, BYTE, 0xFF, "", 0, 43),
    (0x1402, 0, "Largest sub-index supported", U8, "ro", 2, 2, 2, "", 0, 43),
    (0x1402, 1, "COB-ID used by PDO", U32, "rw", None, None, 0x4000_0400 + NODE, "", 0, 43),
    (0x1402, 2, "Transmission type", U8, "rw", 0, BYTE, 0xFF, "", 0, 43),
    (0x1403, 0, "Largest sub-index supported", U8, "ro", 2, 2, 2, "", 0, 43),
    (0x1403, 1, "COB-ID used by PDO", U32, "rw", None, None, 0x4000_0500 + NODE, "", 0, 43),
    (0x1403, 2, "Transmission type", U8, "rw", 0, BYTE, 0xFE, "", 0, 43),
    (0x1600, 0, "Number of mapped application objects in PDO", U8, "rw", 0, 3, 1, "", 0, 45),
    (0x1600, 1, "Mapping entry 1", U32, "rw", None, None, 0x6040_0010, "", 0, 45),
    (0x1600, 2, "Mapping entry 2", U32, "rw", None, None, 0, "", 0, 45),
    (0x1600, 3, "Mapping entry 3", U32, "rw", None, None, 0, "", 0, 45),
    (0x1601, 0, "Number of mapped application objects in PDO", U8, "rw", 0, 3, 2, "", 0, 45),
    (0x1601, 1, "Mapping entry 1", U32, "rw", None, None, 0x6040_0010, "", 0, 45),
    (0x1601, 2, "Mapping entry 2", U32, "rw", None, None, 0x6060_0008, "", 0, 45),
    (0x1601, 3, "Mapping entry 3", U32, "rw", None, None, 0, "", 0, 45),
    (0x1602, 0, "Number of mapped application objects in PDO", U8, "rw", 0, 3, 2, "", 0, 45),
    (0x1602, 1, "Mapping entry 1", U32, "rw", None, None, 0x6040_0010, "", 0, 45),
    (0x1602, 2, "Mapping entry 2", U32, "rw", None, None, 0x607A_0020, "", 0, 45),
    (0x1602, 3, "Mapping entry 3", U32, "rw", None, None, 0, "", 0, 45),
    (0x1603, 0, "Number of mapped application objects in PDO", U8, "rw", 0, 3, 2, "", 0, 45),
    (0x1603, 1, "Mapping entry 1", U32, "rw", None, None, 0x6040_0010, "", 0, 45),
    (0x1603, 2, "Mapping entry 2", U32, "rw", None, None, 0x60FF_0020, "", 0, 45),
    (0x1603, 3, "Mapping entry 3", U32, "rw", None, None, 0, "", 0, 45),
    (0x1800, 0, "Largest sub-index supported", U8, "ro", 5, 5, 5, "", 0, 47),
    (0x1800, 1, "COB-ID", U32, "rw", None, None, 0x4000_0180 + NODE, "", 0, 47),
    (0x1800, 2, "Transmission type", U8, "rw", 0, BYTE, 0xFF, "", 0, 47),
    (0x1800, 3, "Inhibit time", U16, "rw", 0, WORD, 0, "ms", 0, 47),
    (0x1800, 4, "Compatibility entry", U8, "ro", 0, BYTE, 0, "", 0, 47),
    (0x1800, 5, "Event timer", U16, "rw", 0, WORD, 0, "ms", 0, 47),
    (0x1801, 0, "Largest sub-index supported", U8, "ro", 5, 5, 5, "", 0, 47),
    (0x1801, 1, "COB-ID", U32, "rw", None, None, 0x4000_0280 + NODE, "", 0, 47),
    (0x1801, 2, "Transmission type", U8, "rw", 0, BYTE, 0xFF, "", 0, 47),
    (0x1801, 3, "Inhibit time", U16, "rw", 0, WORD, 0, "ms", 0, 47),
    (0x1801, 4, "Compatibility entry", U8, "ro", 0, BYTE, 0, "", 0, 47),
    (0x1801, 5, "Event timer", U16, "rw", 0, WORD, 0, "ms", 0, 47),
    (0x1802, 0, "Largest sub-index supported", U8, "ro", 5, 5, 5, "", 0, 47),
    (0x1802, 1, "COB-ID", U32, "rw", None, None, 0x4000_0380 + NODE, "", 0, 47),
    (0x1802, 2, "Transmission type", U8, "rw", 0, BYTE, 1, "", 0, 47),
    (0x1802, 3, "Inhibit time", U16, "rw", 0, WORD, 0, "ms", 0, 47),
    (0x1802, 4, "Compatibility entry", U8, "ro", 0, BYTE, 0, "", 0, 47),
    (0x1802, 5, "Event timer", U16, "rw", 0, WORD, 0, "ms", 0, 47),
    (0x1803, 0, "Largest sub-index supported", U8, "ro", 5, 5, 5, "", 0, 47),
    (0x1803, 1, "COB-ID", U32, "rw", None, None, 0x4000_0480 + NODE, "", 0, 47),
    (0x1803, 2, "Transmission type", U8, "rw", 0, BYTE, 1, "", 0, 47),
    (0x1803, 3, "Inhibit time", U16, "rw", 0, WORD, 0, "ms", 0, 47),
    (0x1803, 4, "Compatibility entry", U8, "ro", 0, BYTE, 0, "", 0, 47),
    (0x1803, 5, "Event timer", U16, "rw", 0, WORD, 0, "ms", 0, 47),
    (0x1A00, 0, "Number of mapped application objects in PDO", U8, "rw", 0, 3, 1, "", 0, 49),
    (0x1A00, 1, "Mapping entry 1", U32, "rw", None, None, 0x6041_0010, "", 0, 49),
    (0x1A00, 2, "Mapping entry 2", U32, "rw", None, None, 0, "", 0, 49),
    (0x1A00, 3, "Mapping entry 3", U32, "rw", None, None, 0, "", 0, 49),
    (0x1A01, 0, "Number of mapped application objects in PDO", U8, "rw", 0, 3, 2, "", 0, 49),
    (0x1A01, 1, "Mapping entry 1", U32, "rw", None, None, 0x6041_0010, "", 0, 49),
    (0x1A01, 2, "Mapping entry 2", U32, "rw", None, None, 0x6061_0008, "", 0, 49),
    (0x1A01, 3, "Mapping entry 3", U32, "rw", None, None, 0, "", 0, 49),
    (0x1A02, 0, "Number of mapped application objects in PDO", U8, "rw", 0, 3, 2, "", 0, 49),
    (0x1A02, 1, "Mapping entry 1", U32, "rw", None, None, 0x6041_0010, "", 0, 49),
    (0x1A02, 2, "Mapping entry 2", U32, "rw", None, None, 0x6064_0020, "", 0, 49),
    (0x1A02, 3, "Mapping entry 3", U32, "rw", None, None, 0, "", 0, 49),
    (0x1A03, 0, "Number of mapped application objects in PDO", U8, "rw", 0, 3, 2, "", 0, 49),
    (0x1A03, 1, "Mapping entry 1", U32, "rw", None, None, 0x6041_0010, "", 0, 49),
    (0x1A03, 2, "Mapping entry 2", U32, "rw", None, None, 0x606C_0020, "", 0, 49),
    (0x1A03, 3, "Mapping entry 3", U32, "rw", None, None, 0, "", 0, 49),
    # Section 4, manufacturer specific area
    (0x2000, 0, "Highest sub-index supported", U8, "ro", 0, BYTE, 5, "", 0, 51),
    (0x2000, 1, "MC_Type", U32, "ro", 0, DWORD, 0, "", 0, 51),
    (0x2000, 2, "MC_Version", U32, "ro", 0, DWORD, 0, "", 0, 51),
    (0x2000, 3, "MC_Date", U32, "ro", 0, DWORD, 0, "", 0, 51),
    (0x2000, 4, "MC_Time", U32, "ro", 0, DWORD, 0, "", 0, 51),
    (0x2000, 5, "MC_Variant", U32, "ro", 0, DWORD, 0, "", 0, 51),
    (0x2003, 0, "Maximum Current", U32, "rw", 0, 45000, 0, "mA", 0, 53),
    (0x2004, 0, "Open Loop Current", U32, "rw", 0, 45000, 0, "mA", 0, 55),
    (0x2005, 0, "Limit Switches", U32, "rw", 0, 63, 0, "", 0, 57),
    (0x2006, 0, "Highest sub-index supported", U8, "ro", 0, BYTE, 3, "", 0, 60),
    (0x2006, 1, "Enable", U8, "rw", 0, 1, 0, "", 0, 60),
    (0x2006, 2, "Voltage", U16, "rw", 0, WORD, 300, "0.1V", 0, 60),
    (0x2006, 3, "Hysteresis", U8, "rw", 0, BYTE, 5, "", 0, 60),
    (0x2041, 0, "Highest sub-index supported", U8, "ro", 0, BYTE, 6, "", 0, 62),
    (0x2041, 1, "Torque_P", U16, "rw", 0, WORD, 0, "", 0, 62),
    (0x2041, 2, "Torque_I", U16, "rw", 0, WORD, 0, "", 0, 62),
    (0x2041, 3, "PID_Torque_Error", I32, "ro", LOW32, HIGH32, 0, "mA", 0, 62),
    (0x2041, 4, "PID_Torque_Error_Sum", I32, "ro", LOW32, HIGH32, 0, "", 0, 62),
    (0x2041, 5, "PID_Flux_Error", I32, "ro", LOW32, HIGH32, 0, "mA", 0, 62),
    (0x2041, 6, "PID_Flux_Error_Sum", I32, "ro", LOW32, HIGH32, 0, "", 0, 62),
    (0x2042, 0, "Highest sub-index supported", U8, "ro", 0, BYTE, 4, "", 0, 64),
    (0x2042, 1, "P_Parameter", U16, "rw", 0, WORD, 0, "", 0, 64),
    (0x2042, 2, "I_Parameter", U16, "rw", 0, WORD, 0, "", 0, 64),
    (0x2042, 3, "PI_Velocity_Error", I32, "ro", LOW32, HIGH32, 0, "rpm", 0, 64),  # unit: our loop's
    (0x2042, 4, "PI_Velocity_Error_Sum", I32, "ro", LOW32, HIGH32, 0, "", 0, 64),
    (0x2043, 0, "Highest sub-index supported", U8, "ro", 0, BYTE, 3, "", 0, 66),
    (0x2043, 1, "P_Parameter", U16, "rw", 0, WORD, 0, "", 0, 66),
    (0x2043, 2, "PID_Position_Error", I32, "ro", LOW32, HIGH32, 0, "1/65536 rev", 0, 66),  # unit: our loop's
    (0x2043, 3, "AlwaysUseEncoder", U8, "rw", 0, 1, 0, "", 0, 66),
    (0x2050, 0, "Motor Type", U8, "rw", 0, 3, 0, "", 0, 68),
    (0x2055, 0, "Commutation Mode", U8, "rw", 0, 3, 3, "", 0, 71),  # modes of table 69
    (0x2056, 0, "Motor Pole Pairs", U8, "rw", 1, 255, 12, "", 0, 73),  # the table swaps 12 and 255
    (0x2057, 0, "Motor Shaft Direction", U8, "rw", 0, 1, 0, "", 0, 75),
    (0x2058, 0, "Position Scaler", I32, "rw", 1, HIGH32, 65536, "inc/rev", 0, 77),  # the table: any SIGNED32
    (0x2060, 0, "Highest sub-index supported", U8, "ro", 0, BYTE, 7, "", 0, 79),
    (0x2060, 1, "ADC_I0_Raw", U16, "ro", 0, WORD, 0, "", 0, 79),
    (0x2060, 2, "ADC_I1_Raw", U16, "ro", 0, WORD, 0, "", 0, 79),
    (0x2060, 3, "ADC_I0_Offset", U16, "rw", 0, WORD, 33500, "", 0, 79),
    (0x2060, 4, "ADC_I1_Offset", U16, "rw", 0, WORD, 33500, "", 0, 79),
    (0x2060, 5, "ADC_I0", I16, "ro", LOW16, HIGH16, 0, "", 0, 79),
    (0x2060, 6, "ADC_I1", I16, "ro", LOW16, HIGH16, 0, "", 0, 79),
    (0x2060, 7, "ADC_I2", I16, "ro", LOW16, HIGH16, 0, "", 0, 79),
    (0x2070, 0, "Highest sub-index supported", U8, "ro", 0, BYTE, 4, "", 0, 81),
    (0x2070, 1, "Hall Polarity", U8, "rw", 0, 1, 0, "", 0, 81),
    (0x2070, 2, "Hall Direction", U8, "rw", 0, 1, 0, "", 0, 81),
    (0x2070, 3, "Hall Interpolation", U8, "rw", 0, 1, 1, "", 0, 81),
    (0x2070, 4, "Hall PHI_E offset", I16, "rw", LOW16, HIGH16, 0, "1/65536 turn", 0, 81),  # electrical turn
    (0x2080, 0, "Highest sub-index supported", U8, "ro", 0, BYTE, 3, "", 0, 84),
    (0x2080, 1, "Encoder Direction", U8, "rw", 0, 1, 0, "", 0, 84),
    (0x2080, 2, "Encoder Steps", U16, "rw", 0, WORD, 8192, "", 0, 84),
    (0x2080, 3, "Encoder Init Mode", U8, "rw", 0, 2, 0, "", 0, 84),
    (0x2101, 0, "Motor Status Flags", U32, "ro", 0, 0x7FFFF, 0, "", 0, 87),  # up to bit 18, table 85
    (0x2102, 0, "Open Loop Commutation Angle", I16, "ro", LOW16, HIGH16, 0, "1/65536 turn", 0, 89),
    (0x2103, 0, "Encoder Commutation Angle", I16, "ro", LOW16, HIGH16, 0, "1/65536 turn", 0, 91),
    (0x2104, 0, "Hall Commutation Angle", I16, "ro", LOW16, HIGH16, 0, "1/65536 turn", 0, 93),
    (0x2140, 0, "Home Offset Display", I32, "ro", LOW32, HIGH32, 0, "inc", 0, 95),
    (0x2702, 0, "Digital Inputs (GPI0-GPI3)", U32, "ro", 0, 15, 0, "", 0, 97),
    (0x2703, 0, "Highest sub-index supported", U8, "ro", 0, BYTE, 2, "", 0, 100),
    (0x2703, 1, "Physical outputs", U32, "rw", 0, DWORD, 0, "", 1, 100),
    (0x2703, 2, "Output mask", U32, "rw", 0, DWORD, 0, "", 1, 100),
    (0x2704, 0, "CAN Bit Rate", U16, "rw", 20, 1000, 1000, "kbit/s", 0, 102),
    (0x2705, 0, "Node ID", U8, "rw", 1, 127, 1, "", 0, 104),
    (0x2706, 0, "Store", U32, "rw", None, None, 0, "", 0, 106),
    (0x2707, 0, "CAN Bit Rate Load", U16, "ro", 20, 1000, 1000, "kbit/s", 0, 108),  # 1000 needs 16 bits
    (0x2708, 0, "Node ID Load", U8, "ro", 1, 127, 1, "", 0, 110),
    (0x270E, 0, "Highest sub-index supported", U8, "ro", 0, BYTE, 2, "", 0, 112),
    (0x270E, 1, "AI0", U16, "ro", 0, 4095, 0, "", 0, 112),
    (0x270E, 2, "AI1", U16, "ro", 0, 4095, 0, "", 0, 112),
    (0x5FFF, 0, "Bootloader mode", U32, "rw", None, None, 0, "", 0, 114),
    # Section 5, profile specific area
    (0x605A, 0, "Quick stop option code", I16, "rw", 1, 6, 2, "", 0, 117),
    (0x605B, 0, "Shutdown option code", U16, "rw", 0, 0, 0, "", 0, 120),
    (0x605C, 0, "Disable operation option code", U16, "rw", 1, 1, 1, "", 0, 123),
    (0x605D, 0, "Halt option code", U16, "rw", 1, 1, 1, "", 0, 126),
    (0x605E, 0, "Fault reaction option code", U16, "rw", 2, 2, 2, "", 0, 129),
    (0x6060, 0, "Modes of operation", I8, "rw", 0, 10, 0, "", 1, 132),
    (0x6061, 0, "Modes of operation display", I8, "ro", 0, 10, 0, "", 1, 135),  # the table's rw is a slip
    (0x60FD, 0, "Digital inputs", U32, "ro", 0, DWORD, 0, "", 1, 137),  # the table's rw is a slip
    (0x6502, 0, "Supported drive modes", U32, "ro", 0, DWORD, 0b11_1010_0101, "", 0, 140),  # bits of table 138
    # Sections 6 to 11, modes of operation
    (0x6040, 0, "Controlword", U16, "rw", 0, WORD, 0, "", 1, 145),
    (0x6041, 0, "Statusword", U16, "ro", 0, WORD, 0, "", 1, 151),  # the table's rw is a slip
    (0x6062, 0, "Position demand value", I32, "ro", LOW32, HIGH32, 0, "inc", 1, 153),
    (0x6063, 0, "Position actual internal value", I32, "ro", LOW32, HIGH32, 0, "inc", 1, 155),
    (0x6064, 0, "Position actual value", I32, "ro", LOW32, HIGH32, 0, "inc", 1, 157),
    (0x6065, 0, "Following error window", U32, "rw", 0, 2147483647, 0, "inc", 0, 159),
    (0x6067, 0, "Position window", U32, "rw", 0, DWORD, DWORD, "inc", 0, 161),  # off
    (0x6068, 0, "Position window time", U16, "rw", 0, WORD, 0, "ms", 0, 163),
    (0x606C, 0, "Velocity actual value", I32, "ro", LOW32, HIGH32, 0, "pps", 1, 165),
    (0x607A, 0, "Target position", I32, "rw", LOW32, HIGH32, 0, "inc", 1, 167),
    (0x607D, 0, "Highest sub-index supported", U8, "ro", 0, BYTE, 2, "", 0, 169),
    (0x607D, 1, "Minimum Position Limit", I32, "rw", LOW32, HIGH32, LOW32, "inc", 0, 169),
    (0x607D, 2, "Maximum Position Limit", I32, "rw", LOW32, HIGH32, HIGH32, "inc", 0, 169),
    (0x6081, 0, "Profile velocity", U32, "rw", 0, DWORD, 0, "pps", 0, 171),
    (0x6083, 0, "Profile acceleration", U32, "rw", 0, DWORD, 0, "pps^2", 0, 173),
    (0x6084, 0, "Profile deceleration", U32, "rw", 0, DWORD, 0, "pps^2", 0, 175),
    (0x6085, 0, "Quick stop deceleration", U32, "rw", 0, DWORD, 51200, "pps^2", 0, 177),
    (0x60F2, 0, "Positioning option code", U16, "rw", 0, 2, 0, "", 0, 180),  # table 178: 3 is reserved, no other bits
    (0x60FF, 0, "Target velocity", I32, "rw", LOW32, HIGH32, 0, "pps", 1, 208),
    (0x607C, 0, "Home offset", I32, "rw", LOW32, HIGH32, 0, "inc", 0, 224),
    (0x6098, 0, "Homing method", I8, "rw", 0, 35, 0, "", 0, 226),
    (0x6099, 0, "Highest sub-index supported", U8, "ro", 0, BYTE, 2, "", 0, 228),
    (0x6099, 1, "Fast homing speed", U32, "rw", 0, DWORD, 0, "pps", 0, 228),
    (0x6099, 2, "Slow homing speed", U32, "rw", 0, DWORD, 0, "pps", 0, 228),
    (0x609A, 0, "Homing acceleration", U32, "rw", 0, DWORD, 0, "pps^2", 0, 230),
    (0x60B0, 0, "Position offset", I32, "rw", LOW32, HIGH32, 0, "inc", 1, 254),
    (0x60C2, 0, "Highest sub-index supported", U8, "ro", 0, BYTE, 2, "", 0, 256),
    (0x60C2, 1, "Interpolation time period value", U8, "rw", 0, BYTE, 1, "", 0, 256),
    (0x60C2, 2, "Interpolation time index", I8, "rw", -3, 3, -3, "", 0, 256),
    (0x60B1, 0, "Velocity offset", I32, "rw", LOW32, HIGH32, 0, "pps", 1, 274),
    (0x6071, 0, "Target torque", I16, "rw", LOW16, HIGH16, 0, "mA", 1, 294),
    (0x6077, 0, "Torque actual value", I16, "ro", LOW16, HIGH16, 0, "mA", 1, 296),
    (0x60B2, 0, "Torque offset", I16, "rw", LOW16, HIGH16, 0, "mA", 1, 300),
]


def read(node_id):
    return canopen.import_od(str(EDS), node_id=node_id)


def all_entries(od):
    for obj in od.values():
        yield from [obj] if isinstance(obj, ODVariable) else obj.subindices.values()


def entry(od, index, sub):
    obj = od[index]
    return obj if isinstance(obj, ODVariable) else obj.subindices[sub]


OD = read(NODE)  # read once: the tests below only look


@every_row(
    ("index", "sub", "name", "data_type", "access", "low", "high", "default", "unit", "mappable", "table"), ENTRIES
)
def test_entry_is_as_in_the_manual(index, sub, name, data_type, access, low, high, default, unit, mappable, table):
    found = entry(OD, index, sub)
    assert (found.index, found.subindex, found.name) == (index, sub, name)
    assert found.data_type == getattr(datatypes, data_type)
    assert found.access_type == access
    assert (found.min, found.max) == (low, high)
    assert found.default == default
    assert found.unit == unit
    assert found.pdo_mappable is bool(mappable)


@every_row(("index", "name", "kind"), GROUPS)
def test_record_or_array_is_as_in_the_manual(index, name, kind):
    assert type(OD[index]) is kind
    assert OD[index].name == name


def test_dictionary_and_table_hold_the_same_entries():
    rows = [(row[0], row[1]) for row in ENTRIES]
    assert len(rows) == len(set(rows))
    assert sorted(rows) == sorted((found.index, found.subindex) for found in all_entries(OD))
    grouped = {index for index, obj in OD.items() if not isinstance(obj, ODVariable)}
    assert {index for index, *_ in GROUPS} == grouped


def test_cob_ids_follow_the_node_id():
    cob_ids = [(0x1014, 0)] + [(index + k, 1) for index in (0x1400, 0x1800) for k in range(4)]
    other = read(NODE + 1)
    follow = [(found.index, found.subindex) for found in all_entries(OD) if found.relative]
    moved = [
        (a.index, a.subindex)
        for a, b in zip(all_entries(OD), all_entries(other), strict=True)
        if a.default != b.default
    ]
    assert follow == moved == cob_ids


def test_every_section_has_the_keys_of_its_kind():
    eds = configparser.RawConfigParser()
    eds.optionxform = str
    eds.read_string(EDS.read_text("ascii"))
    for index in OD:
        section = eds[f"{index:04X}"]
        if section["ObjectType"] != "0x7":
            assert section["ObjectType"] == ("0x8" if isinstance(OD[index], ODArray) else "0x9")
            assert int(section["SubNumber"], 16) == len(OD[index].subindices)
    for found in all_entries(OD):
        top = eds[f"{found.index:04X}"]["ObjectType"] == "0x7"
        section = eds[f"{found.index:04X}" if top else f"{found.index:04X}sub{found.subindex:X}"]
        wanted = {"ParameterName", "ObjectType", "DataType", "AccessType", "DefaultValue", "PDOMapping"}
        if found.min is not None:
            wanted |= {"LowLimit", "HighLimit"}
        assert set(section) - {"Unit"} == wanted
        assert section["ObjectType"] == "0x7"


def test_every_object_names_its_tables():
    lines = EDS.read_text("ascii").splitlines()
    for index in OD:
        above = lines.index(f"[{index:04X}]") - 1
        while lines[above].startswith(";") and not lines[above].startswith("; tables "):
            above -= 1
        named = set(map(int, lines[above].removeprefix("; tables ").split(", ")))
        assert named >= {row[-1] for row in ENTRIES if row[0] == index}


def test_device_information():
    device = OD.device_information
    assert device.vendor_number == 0x286
    assert device.product_number == 1636
    assert device.revision_number == OD[0x1018][3].default
    assert device.allowed_baudrates == {20_000, 50_000, 125_000, 250_000, 500_000, 800_000, 1_000_000}
    assert (device.nr_of_RXPDO, device.nr_of_TXPDO) == (4, 4)
    assert device.simple_boot_up_slave and not device.LSS_supported and not device.dynamic_channels_supported
