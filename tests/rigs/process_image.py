"""The process image of emulated drives, without a slave around it."""

from __future__ import annotations

from collections.abc import Callable

from drive_env.emulator.emulated_drives import EmulatedDrives
from drive_env.node.axis import Axis
from drive_env.node.node_dictionary import NodeDictionary
from drive_env.node.process_image import ImageObjects


class ProcessImage(ImageObjects):
    """The process image of a device with sync managers, connected to emulated axes.

    Args:
        drives: The emulated drives.
        first_axis: Number of the device's first axis among the drives'.
        may_change: Returns whether the image may be changed now.

    Raises:
        ValueError: For a device without sync managers, or axes that the drives do not have.

    Attributes:
        dictionary: All objects by index and sub-index, including the image's.
        commands: Objects whose write is a command: empty.
    """

    def __init__(
        self, drives: EmulatedDrives, first_axis: int = 0, may_change: Callable[[], bool] = lambda: True
    ) -> None:
        device, objects = drives.device, drives.inside.objects
        super().__init__(device, objects.entries, may_change)
        if not 0 <= first_axis <= drives.num_axes - device.num_axes:
            raise ValueError(
                f"the image of {device.name} carries {device.num_axes} axes from first_axis={first_axis} on, and there "
                f"are {drives.num_axes}: take a load, or a number of machines, with {device.num_axes} axes"
            )
        self.commands: dict[tuple[int, int], Callable[[int], None]] = {}
        axes = [Axis(objects, first_axis + k) for k in range(device.num_axes)]
        self.dictionary = NodeDictionary(device, objects.entries, self, axes)
        self.connect(self.dictionary.port)
