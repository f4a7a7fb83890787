"""What tests and models cost: ``pytest --costs 20`` lists the 20 of each that took most processor time.

The time of a test is that of its process and of the processes that it started and waited for, with its fixtures, and
with the models that it compiled, which the second list has by themselves.
"""

import os
from collections import defaultdict
from contextlib import contextmanager

import pytest

from fourbar_codegen.building import cache


def processor_time():
    return sum(os.times()[:4])


class Costs:
    """A plugin of pytest."""

    def __init__(self, shown):
        self.shown = shown
        self.tests, self.models = {}, defaultdict(float)
        self.built, self.stack = [], []

    @contextmanager
    def measured(self):
        """The processor time of what runs inside, without that of entries of the cache that are made inside."""
        begin = processor_time()
        self.stack.append(0.0)
        spent = []
        try:
            yield spent
        finally:
            total = processor_time() - begin
            spent.append(total - self.stack.pop())
            if self.stack:
                self.stack[-1] += total

    def watch(self):
        """Measure what is built for the cache in this process."""
        cached = cache._cached

        def watched(place, build, limit):
            def measured(folder):
                with self.measured() as spent:
                    done = build(folder)
                self.built.append((place.name, *spent))
                return done

            return cached(place, measured, limit)

        cache._cached = watched

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item):
        self.begin = processor_time()
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item, call):
        report = yield
        if call.when == "teardown":
            report.user_properties.append(("cost", (processor_time() - self.begin, self.built)))
            self.built = []
        return report

    def pytest_runtest_logreport(self, report):
        for name, value in report.user_properties:
            if name == "cost":
                self.tests[report.nodeid], built = value
                for entry, spent in built:
                    self.models[entry] += spent

    def pytest_terminal_summary(self, terminalreporter):
        for title, costs in (("tests", self.tests), ("entries of the cache", self.models)):
            terminalreporter.section(f"{title} by processor time, {sum(costs.values()):.0f} s in all", sep="-")
            for name, spent in sorted(costs.items(), key=lambda pair: -pair[1])[: self.shown]:
                terminalreporter.write_line(f"{spent:8.1f} s  {name}")


def pytest_addoption(parser):
    parser.addoption("--costs", type=int, metavar="N", help="list N tests and models by processor time")


def pytest_configure(config):
    shown = config.getoption("--costs")
    if shown:
        costs = Costs(shown)
        costs.watch()
        config.pluginmanager.register(costs)
