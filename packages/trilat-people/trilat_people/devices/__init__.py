"""Drivers for input devices with which a person moves an arm, one file per device.

A driver is a class that implements `Device`. `open_device` finds it by file name: for example,
`trilat hand m1 --device spacemouse` opens the class in spacemouse.py. To add a driver, add a
file.
"""

from importlib import import_module
from pkgutil import iter_modules

from trilat_net.app import Device
from trilat_net.errors import UsageError


def open_device(text: str) -> Device:
    """Connects to the input device given by the option --device.

    Args:
        text: Value of the option: the name of a device, optionally followed by "=" and its
            address, as in "spacemouse" or "haply_inverse3=ws://127.0.0.1:10001".

    Raises:
        UsageError: There is no such device.
    """
    name, _, address = text.partition("=")
    device_names = sorted(module_info.name for module_info in iter_modules(__path__))
    if name not in device_names:
        raise UsageError(
            f"--device must be one of {', '.join(device_names)}, "
            f"optionally followed by =ADDRESS, not {text!r}"
        )

    module = import_module(f"{__name__}.{name}")

    # The class in the file spacemouse.py is SpaceMouse: the names differ only in capitals and
    # "_".
    class_name = name.replace("_", "")
    members = vars(module).items()
    device_class = next(
        member for member_name, member in members if member_name.lower() == class_name
    )
    device: Device = device_class(address) if address else device_class()
    return device
