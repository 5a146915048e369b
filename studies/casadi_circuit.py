# SPDX-License-Identifier: Apache-2.0
"""What `joint` computes in NumPy, as CasADi expressions: the measurement that decided for NumPy.

The node Laplacian of all 2RC + R + C nodes, sparse LDL, and the same adjoint derivatives:

    L = A^T diag(1/r) A ,   L V = U ,   rho_p = U_p^T V_p ,   d rho_p / d log r_e = (A V)_ep^2 / r_e

====== ============== ================================================= =====
symbol shape          meaning                                           unit
====== ============== ================================================= =====
r      (3RC,)         resistances: cells, top wires, bottom wires       ohm
A      (3RC, nodes)   incidence: each resistor's two ends               1
U      (nodes, RC)    unit currents through the ports                   A
V      (nodes, RC)    node potentials for them                          V
rho    (RC,)          port resistances                                  ohm
J      (RC, 3RC)      their derivatives by log r                        ohm
====== ============== ================================================= =====
"""

from __future__ import annotations

import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import casadi
import numpy as np

from ohmskin.arrays import Float
from ohmskin.circuit.skin import PortCircuit

NUMPY: Final = "numpy"
MACHINE: Final = "casadi"  # its virtual machine
GENERATED_C: Final = "casadi_c"
EVALUATIONS: Final = (NUMPY, MACHINE, GENERATED_C)
COMPILER: Final = "cc"
_WARM_UP: Final = 5
_CALLS: Final = 50

# From log r (3RC,) to rho, and J in blocks of columns: no time goes into putting them together.
Evaluation = Callable[[Float], list[Float]]


def evaluations(rows: int, columns: int) -> dict[str, Evaluation]:
    """The three ways to compute rho and J, by name; without a C compiler two.

    CasADi's answers are its own buffers, overwritten by the next call.
    """
    function = linearisation(rows, columns)

    def numpy(log_ohm: Float) -> list[Float]:
        cell, top, bottom = np.exp(log_ohm).reshape(3, rows, columns)
        found = PortCircuit(1 / cell, top, bottom)
        return [found.port_ohm, found.by_cell(), found.by_wires()]

    found: dict[str, Evaluation] = {NUMPY: numpy, MACHINE: _ThroughBuffers(function)}
    compiled = _compiled(function)
    if compiled is not None:
        found[GENERATED_C] = _ThroughBuffers(compiled)
    return found


def times_ms(rows: int, columns: int) -> dict[str, Float]:
    """Milliseconds of every call of each of the `evaluations`, shape (calls,), by name."""
    random = np.random.default_rng(0)
    middles = np.log([1e6, 100.0, 200.0])
    log_ohm = (middles[:, None] + 0.5 * random.standard_normal((3, rows * columns))).ravel()
    return {name: _times_ms(call, log_ohm) for name, call in evaluations(rows, columns).items()}


def _times_ms(call: Evaluation, log_ohm: Float) -> Float:
    times_s = []
    for _ in range(_WARM_UP + _CALLS):
        started_s = time.perf_counter()
        call(log_ohm)
        times_s.append(time.perf_counter() - started_s)
    return 1e3 * np.array(times_s[_WARM_UP:])


def linearisation(rows: int, columns: int) -> Any:
    """CasADi function: log r (3RC,) -> rho (RC,), J (RC, 3RC)."""
    cells = rows * columns
    nodes = 2 * cells + rows + columns
    incidence = np.zeros((3 * cells, nodes))
    ports = np.zeros((nodes, cells))
    for row, column in np.ndindex(rows, columns):
        cell = row * columns + column
        top, bottom = cell, cells + cell
        row_electrode, column_electrode = 2 * cells + row, 2 * cells + rows + column
        before_top = top - 1 if column else row_electrode
        before_bottom = bottom - columns if row else column_electrode
        for resistor, (one, other) in enumerate(
            ((top, bottom), (before_top, top), (before_bottom, bottom))
        ):
            incidence[resistor * cells + cell, [one, other]] = 1, -1
        ports[row_electrode, cell] = 1
        ports[column_electrode, cell] = -1
    # The last node is ground.
    joins, driven = casadi.sparsify(casadi.DM(incidence[:, :-1])), casadi.DM(ports[:-1])
    log_ohm = casadi.MX.sym("log_ohm", 3 * cells)
    siemens = casadi.exp(-log_ohm)
    laplacian = casadi.mtimes([joins.T, casadi.diag(siemens), joins])
    volt = casadi.solve(laplacian, driven, "ldl")
    across = casadi.mtimes(joins, volt)
    slopes = casadi.mtimes(casadi.diag(siemens), across * across).T
    outputs = [casadi.densify(casadi.sum1(driven * volt).T), casadi.densify(slopes)]
    return casadi.Function("linearisation", [log_ohm], outputs)


class _ThroughBuffers:
    """The function on NumPy's memory: an ordinary call, with the copy of what it returns into
    NumPy's arrays, takes nearly three times as long at 16x16.
    """

    def __init__(self, function: Any) -> None:
        self._log_ohm, self._port_ohm = (
            np.zeros(function.numel_in(0)),
            np.zeros(function.numel_out(0)),
        )
        by_columns = np.zeros(function.numel_out(1))  # CasADi's order
        self._slopes = by_columns.reshape(self._log_ohm.size, self._port_ohm.size).T
        # Kept, for the evaluation does not keep it.
        self._buffer, self._evaluate = function.buffer()
        self._buffer.set_arg(0, self._log_ohm.data)
        self._buffer.set_res(0, self._port_ohm.data)
        self._buffer.set_res(1, by_columns.data)

    def __call__(self, log_ohm: Float) -> list[Float]:
        self._log_ohm[:] = log_ohm
        self._evaluate()
        return [self._port_ohm, self._slopes]


def _compiled(function: Any) -> Any | None:
    """The function as C that CasADi generates, compiled and loaded; None without a compiler."""
    with tempfile.TemporaryDirectory() as folder:
        generator = casadi.CodeGenerator("linearisation.c")
        generator.add(function)
        source = generator.generate(f"{folder}/")
        library = Path(folder) / "linearisation.so"
        command = [COMPILER, "-O3", "-fPIC", "-shared", source, "-o", str(library), "-lm"]
        try:
            subprocess.run(command, check=True, capture_output=True)
        except (OSError, subprocess.CalledProcessError):
            return None
        return casadi.external("linearisation", str(library))
