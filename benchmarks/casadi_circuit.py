# SPDX-License-Identifier: Apache-2.0
"""What `joint` computes in NumPy, as CasADi expressions: the measurement that decided for NumPy.

The node Laplacian of all 2RC + R + C nodes, sparse LDL, and the same adjoint derivatives:

    L = A^T diag(1/r) A ,   L V = U ,   rho_p = U_p^T V_p ,   d rho_p / d log r_e = (A V)_ep^2 / r_e

with A the incidence of all 3RC resistors and U unit currents through the ports.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from ohmskin.circuit import port_sensitivity


def linearisation(rows: int, columns: int) -> Any:
    """CasADi function: log resistances (3RC), cells, top, bottom -> rho (RC), J (RC, 3RC)."""
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
    joins, driven = ca.sparsify(ca.DM(incidence[:, :-1])), ca.DM(ports[:-1])
    log_ohm = ca.MX.sym("log_ohm", 3 * cells)
    siemens = ca.exp(-log_ohm)
    laplacian = ca.mtimes([joins.T, ca.diag(siemens), joins])
    volt = ca.solve(laplacian, driven, "ldl")
    across = ca.mtimes(joins, volt)
    slopes = ca.mtimes(ca.diag(siemens), across * across).T
    return ca.Function("linearisation", [log_ohm], [ca.sum1(driven * volt).T, slopes])


def median_ms(call: Callable[[], object], calls: int = 40) -> float:
    call()
    taken = []
    for _ in range(calls):
        started = time.perf_counter()
        call()
        taken.append(time.perf_counter() - started)
    return round(1e3 * float(np.median(taken)), 3)


def measure(lines: int) -> dict[str, float | None]:
    """Milliseconds of rho and all derivatives: NumPy, CasADi's machine, and C that it generates."""
    cells = lines * lines
    random = np.random.default_rng(0)
    middles = np.log([1e6, 100.0, 200.0])
    log_ohm = (middles[:, None] + 0.5 * random.standard_normal((3, cells))).ravel()
    cell, top, bottom = log_ohm.reshape(3, lines, lines)
    function = linearisation(lines, lines)

    def numpy() -> np.ndarray:
        found = port_sensitivity(np.exp(-cell), np.exp(top), np.exp(bottom))
        return np.hstack([found.by_cell, found.by_wires()])

    slopes = numpy()
    np.testing.assert_allclose(function(log_ohm)[1], slopes, atol=1e-8 * slopes.max())
    name = f"ms_linearise_{lines}x{lines}"
    return {
        f"{name}_numpy": median_ms(numpy),
        f"{name}_casadi": median_ms(lambda: function(log_ohm)),
        f"{name}_casadi_c": _compiled_ms(function, log_ohm),
    }


def _compiled_ms(function: Any, log_ohm: np.ndarray) -> float | None:
    """None without a compiler."""
    with tempfile.TemporaryDirectory() as folder:
        before = Path.cwd()
        os.chdir(folder)  # CasADi writes where it is
        try:
            function.generate("linearisation.c")
            command = [
                "gcc",
                "-O2",
                "-fPIC",
                "-shared",
                "linearisation.c",
                "-o",
                "linearisation.so",
            ]
            subprocess.run(command, check=True, capture_output=True)
            compiled = ca.external("linearisation", str(Path(folder) / "linearisation.so"))
        except (OSError, subprocess.CalledProcessError):
            return None
        finally:
            os.chdir(before)
        return median_ms(lambda: compiled(log_ohm))
