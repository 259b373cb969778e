"""An EDS as other makers write them, and objects that ours lacks."""

from __future__ import annotations

import re

from drive_env.devices import find_device


def foreign(tmp_path, more=""):
    """Return an EDS as other makers write them: without units, which CiA 306 does not know."""
    text = find_device("tmcm1636").eds.read_text(encoding="utf-8")
    text = re.sub(r"(?m)^;?\s*Unit=.*\n", "", text)
    path = tmp_path / "foreign.eds"
    path.write_text(text + more, encoding="utf-8")
    return path


ABORT_CONNECTION = """
[6007]
ParameterName=Abort connection option code
ObjectType=0x7
DataType=0x0003
AccessType=rw
DefaultValue=1
PDOMapping=0
"""
ENCODER_RESOLUTION = """
[608F]
ParameterName=Position encoder resolution
ObjectType=0x8
SubNumber=3
[608Fsub0]
ParameterName=Highest sub-index supported
ObjectType=0x7
DataType=0x0005
AccessType=ro
DefaultValue=2
PDOMapping=0
[608Fsub1]
ParameterName=Encoder increments
ObjectType=0x7
DataType=0x0007
AccessType=rw
DefaultValue=65536
PDOMapping=0
[608Fsub2]
ParameterName=Motor revolutions
ObjectType=0x7
DataType=0x0007
AccessType=rw
DefaultValue=1
PDOMapping=0
"""
MAX_PROFILE_VELOCITY = """
[607F]
ParameterName=Max profile velocity
ObjectType=0x7
DataType=0x0007
AccessType=rw
DefaultValue=0
PDOMapping=0
;Unit=pps
"""
