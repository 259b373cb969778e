"""An importer of FMUs, FMPy, in a process of its own: what it met with an FMU of a one-axis drive, as JSON.

python tests/fmu_importer.py servo.fmu
"""

import json
import sys

import fmpy
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave

CYCLE = 0.001
P, SPEED = "'Position Mode Settings'.P_Parameter", "'Profile velocity'"


class Instance:
    """An instance of the FMU; values are set and got by name."""

    def __init__(self, description, folder):
        self.time, self.said = 0.0, []
        self.variables = {one.name: one for one in description.modelVariables}
        self.is_fmi3 = description.fmiVersion.startswith("3")
        kind = FMU3Slave if self.is_fmi3 else FMU2Slave
        self.fmu = kind(guid=description.guid, unzipDirectory=folder, instanceName="drive",
                        modelIdentifier=description.coSimulation.modelIdentifier)  # fmt: skip
        if self.is_fmi3:
            self.fmu.instantiate(logMessage=lambda env, status, category, text: self.said.append(text.decode()))
        else:
            self.fmu.instantiate()

    def begin(self, **parameters):
        if not self.is_fmi3:
            self.fmu.setupExperiment(startTime=0.0)
        self.fmu.enterInitializationMode()
        self.set(**parameters)
        self.fmu.exitInitializationMode()
        return self

    def states(self, what, *given):
        """Call getFMUState and the like, which FMI 2 spells another way."""
        name = what if self.is_fmi3 else what.replace("State", "state").replace("deserialize", "deSerialize")
        return getattr(self.fmu, name)(*given)

    def set(self, **values):
        for name, value in values.items():
            one = self.variables[name]
            getattr(self.fmu, f"set{one.type}")([one.valueReference], [value])

    def get(self, name):
        one = self.variables[name]
        return getattr(self.fmu, f"get{one.type}")([one.valueReference])[0]

    def step(self, size=CYCLE, **values):
        self.set(**values)
        self.fmu.doStep(self.time, size)
        self.time += size

    def run(self, cycles):
        for _ in range(cycles):
            self.step()
        return [self.get(name) for name in ("statusword", "position_actual_value", "velocity_actual_value")]

    def move(self):
        self.step(mode_of_operation=1)
        for word in (6, 7, 15):
            self.step(controlword=word)
        self.step(0.01)
        self.step(target_position=60_000, controlword=31)


def refused(call):
    try:
        call()
    except FMICallException as error:
        return str(error)
    return None


def main():
    description, folder = fmpy.read_model_description(sys.argv[1]), fmpy.extract(sys.argv[1])
    one = Instance(description, folder).begin()
    found = {"start": one.run(1)}
    one.move()
    one.run(40)
    state = one.states("getFMUState")
    data = one.states("serializeFMUState", state)
    found["onwards"] = one.run(50)
    one.states("setFMUState", state)
    found["from the state"] = one.run(50)
    one.states("freeFMUState", state)
    one.states("setFMUState", one.states("deserializeFMUState", data))
    found["from its bytes"] = one.run(50)
    found["wrong step"] = refused(lambda: one.step(0.0015))
    found["wrong input"] = refused(lambda: one.step(mode_of_operation=99))
    one.set(mode_of_operation=1)
    found["after refusals"], found["goes on"] = one.run(0), one.run(1)
    other = Instance(description, folder).begin()
    found["other at rest"] = other.run(5)
    other.states("setFMUState", other.states("deserializeFMUState", data))
    found["other, from the bytes"] = other.run(50)
    found["first, untouched"] = one.run(0)
    if one.is_fmi3:  # FMI 2's library cannot reset, and shows no log here
        one.fmu.reset()
        one.begin(**{P: 50, SPEED: 100_000})
        found["reset"] = [one.get(P), one.get(SPEED), *one.run(0)]
        found["said"], third = one.said, Instance(description, folder)
        found["wrong parameter"] = refused(lambda: third.begin(**{P: -1}))
        found["said of it"] = third.said
    else:
        one.fmu.terminate()
        one.fmu.freeInstance()
        found["other, alone"] = other.run(0)
        other.fmu.terminate()
        other.fmu.freeInstance()
        found["third at rest"] = Instance(description, folder).begin().run(5)
    print(json.dumps(found))


if __name__ == "__main__":
    main()
