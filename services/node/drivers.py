"""Makes the driver of a device from services.toml. Everything that can go wrong becomes one error
that names the device."""

from __future__ import annotations

import inspect
import logging

from petrobot.services.comm.location_file import DeviceEntry, Directory, DirectoryError, resolve
from petrobot.services.device import (
    Driver,
    Ports,
    can_move,
    fault_of_period,
    faults_of_limits,
    faults_of_methods,
)
from petrobot.services.worker.callables import RAISED, describe, log_fault

_log = logging.getLogger(__name__)


def make_driver(directory: Directory, device: DeviceEntry, ports: Ports) -> Driver:
    """Return the device's driver, `Class(config, ports)`. Raises DirectoryError with the device,
    its driver and what is wrong."""
    here = f"{directory.source}: devices.{device.name}"
    config = dict(device.config)
    if directory.dry_run:
        config["dry_run"] = True
    try:
        kind = resolve(device.driver)
        if inspect.isclass(kind):
            # Set points may move a device whose driver forgot to override `stop`.
            streams = directory.streams.values()
            moves = can_move(kind) or any(stream.to == device.name for stream in streams)
            if faults := faults_of_limits(kind, config, moves):
                raise ValueError("; ".join(text for _, text in faults))
            if not moves:
                config.pop("dry_run", None)
        driver: Driver = kind(config, ports)
    except ImportError as fault:
        raise DirectoryError((f"{here}.driver: {fault}",)) from fault
    except DirectoryError:  # of its ports: it names the device and the remedy
        raise
    except OSError as fault:
        text = f"{here}: {device.driver} cannot open its device: {fault}"
        raise DirectoryError(
            (f"{text}; check that it is connected, and that this user may open it",)
        ) from fault
    except (KeyError, TypeError, ValueError) as fault:
        told = f"is missing {fault}" if isinstance(fault, KeyError) else str(fault)
        remedy = "correct the keys of this table, or the driver"
        raise DirectoryError((f"{here}: {device.driver} refuses it: {told}; {remedy}",)) from fault
    except RAISED as fault:  # not a bad key, which raises one of the above, but a bug
        log_fault(_log, fault, "device %s: its driver cannot be made", device.name)
        raise DirectoryError(
            (f"{here}: {device.driver} failed: {describe(fault)}; correct the driver",)
        ) from fault
    missing = [
        m
        for m in ("period", "state", "stop", "stopped", "hold", "release", "close")
        if not hasattr(driver, m)
    ]
    if missing:
        text = (
            f"{device.driver} is not a driver: it has no {', '.join(missing)}; derive it from "
            "petrobot.Driver"
        )
        raise DirectoryError((f"{here}.driver: {text}",))
    if odd := faults_of_methods(driver):  # also one that hides a method by a value of its own
        raise DirectoryError((f"{here}.driver: {'; '.join(odd)}",))
    if wrong := fault_of_period(driver):
        raise DirectoryError((f"{here}.driver: {device.driver}.{wrong}",))
    return driver
