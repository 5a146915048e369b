# SPDX-License-Identifier: Apache-2.0
"""What boards with older firmware say and take, translated from and to the names of today.

A board is flashed once and used for years. So this host reads boards, and recordings, of every
definition that was ever shipped (`protocol.definition`). `today` gives fields that such a board
sends the names of today. `asked` gives the fields of a command the names that the board knows.
Fields of today's definition stay as they are.
"""

from typing import Any

from ohmskin.link import protocol

# What `adc_prescaler` was called before boards had accuracies, in the order of these.
_PRESCALERS = ("clock_500khz", "clock_250khz", "clock_125khz")
_ACCURACIES = dict(zip(_PRESCALERS, protocol.ENUMS["accuracy"].values, strict=True))
# Multiplexers of all boards of before hellos had `rows_max`.
_INPUTS_BEFORE = 16


def today(frame: str, values: dict[str, Any]) -> dict[str, Any]:
    """Fields of a board's frame, or of its hello in a recording, with the names of now."""
    if frame not in ("hello", "scan", "ack"):
        return values
    values = dict(values)
    if frame == "ack":
        return {"time_us": None, "rate_mhz": 0} | values
    if "adc_prescaler" in values:
        prescaler = values.pop("adc_prescaler")
        values["accuracy"] = _ACCURACIES.get(prescaler, prescaler)
    if "row_mask" in values or not {"rows", "columns"} <= values.keys():
        return values
    masks = protocol.whole_masks(values["rows"], values["columns"])
    if frame == "scan":
        return {"adc_bits": protocol.ADC_BITS, "slot_cycles": 0} | masks | values
    values.pop("readings_per_cell", None)
    zeros = dict.fromkeys(("wiring", "whole_scan_cycles", "whole_every", "dropped", "late"), 0)
    inputs = {"rows_max": _INPUTS_BEFORE, "columns_max": _INPUTS_BEFORE}
    return zeros | inputs | {"whole_mode": "near"} | masks | values


def asked(
    definition: protocol.Definition, command: str, values: dict[str, Any]
) -> dict[str, Any] | None:
    """The fields of a command as a board of this definition takes them; None: it cannot do that."""
    frame = definition.frames.get(command)
    names = [] if frame is None else [field.name for field in frame.fields]
    if frame is None or set(names) == values.keys():
        return None if frame is None else values
    whole = protocol.whole_masks(values["rows"], values["columns"])
    is_whole = whole.items() <= values.items() and not values["whole_every"]
    if not is_whole or values["mode"] not in definition.modes:
        return None
    of_accuracy = dict(zip(_ACCURACIES.values(), _ACCURACIES, strict=True))
    values = values | {"adc_prescaler": of_accuracy[values["accuracy"]]}
    return {name: values[name] for name in names}
