# SPDX-License-Identifier: Apache-2.0
"""Reads what check.h prints: Unity's format, without Unity's library."""

import re

import click
from platformio.public import UnityTestRunner
from platformio.test.exception import UnitTestError
from platformio.test.result import TestStatus
from platformio.util import strip_ansi_codes


class CustomTestRunner(UnityTestRunner):
    """A suite passes only if it ran to its end and every test it counted has reported."""

    EXTRA_LIB_DEPS = None  # nothing to download

    def setup(self):
        self.passed_expected = None
        self.other_lines = []

    def configure_build_env(self, env):
        return env  # no unity_config.h

    def on_testing_line_output(self, line):
        # simavr colours what a board prints, and shows the line's end as a full stop.
        line = strip_ansi_codes(line).rstrip().removesuffix(".") + "\n"
        super().on_testing_line_output(line)
        if summary := re.search(r"(\d+) Tests (\d+) Failures 0 Ignored", line):
            tests, failures = map(int, summary.groups())
            self.passed_expected = tests - failures
        elif not self.parse_test_case(line):
            self.other_lines.append(line)

    def stage_testing(self):
        try:
            super().stage_testing()
            if not self.options.without_testing:
                self.check_complete()
        except UnitTestError:
            if not self.options.verbose:
                click.echo("".join(self.other_lines), nl=False)
            raise

    def check_complete(self):
        if self.passed_expected is None:
            raise UnitTestError("The test program ended without its summary")
        passed = self.test_suite.get_status_nums(TestStatus.PASSED)
        if passed != self.passed_expected:
            raise UnitTestError(f"{self.passed_expected} tests passed, {passed} were reported")
        if not self.test_suite.cases:
            raise UnitTestError("The test program holds no test")
