"""The process image of emulated drives, without a slave around it."""

from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.node.axis import Axis
from drive_env.node.node_dictionary import NodeDictionary
from drive_env.node.process_image import ImageObjects


class ProcessImage(ImageObjects):
    """The image of a device with sync managers, for the drives' axes from `first_axis` on."""

    def __init__(self, drives, first_axis=0, may_change=lambda: True):
        device, objects = drives.device, drives.inside.objects
        super().__init__(device, objects.entries, may_change)
        self.commands = {}
        axes = [Axis(objects, first_axis + k) for k in range(device.num_axes)]
        self.dictionary = NodeDictionary(device, objects.entries, self, axes)
        self.connect(self.dictionary.port)


def write(image, index, sub, raw):
    """Write an object, as a node does at an SDO; return 0, or the abort code."""
    port = image.dictionary.port(index, sub)
    try:
        port.check(raw)
    except ObjectAccessError as error:
        return error.abort_code
    port.write(raw)
    return 0
