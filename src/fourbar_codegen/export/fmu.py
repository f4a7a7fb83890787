"""A model as a Functional Mock-up Unit: its description in XML, and the source around its C library, as text.

Source: Modelica Association, Functional Mock-up Interface, versions 2.0.5 and 3.0.2, https://fmi-standard.org.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple
from xml.etree import ElementTree as ET

from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.export.c_library import FOLDER
from fourbar_codegen.layout import Layout
from fourbar_codegen.runtime.enumerations import QUANTITIES, STIFF, EventRow, Watched

__all__ = [
    "Indicator",
    "build_description",
    "description",
    "fmu_source",
    "sources_of",
    "variables_of",
    "watched_variable",
]

XML_CHARACTERS = "\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff"
"""Those of XML 1.0 (https://www.w3.org/TR/xml/#charsets), besides the ends of lines and tabulators."""


@dataclass(frozen=True)
class Variable:
    """A scalar variable.

    Attributes
    ----------
    reference : int
        Its value reference.
    name, description, unit : str
    kind : str
        ``time``, ``state``, ``rate``, ``parameter``, ``input``, or ``output`` for all that follows from these.
    start : float or None
    is_exact : bool
        Of a state, whether its start value is kept; others are guesses.
    of : int or None
        Of a rate, the value reference of its state.
    needs_inputs : bool
        Of an output, whether it depends on inputs besides those that prescribe motions.
    """

    reference: int
    name: str
    description: str
    unit: str
    kind: str
    start: float | None = None
    is_exact: bool = False
    of: int | None = None
    needs_inputs: bool = True


class Indicator(NamedTuple):
    """An event of an FMU: a change of sign of the variable with a value reference."""

    reference: int
    event: EventRow


@dataclass(frozen=True)
class _Group:
    """Results that a function of the library evaluates at once.

    Attributes
    ----------
    function : str
        The function's name, after that of the model.
    watched : Watched or None
        What the results are for events; None if they are not watched.
    results : sequence of tuple
        Name, description and unit of each; None for those that are not variables.
    per_argument : int
        The number of results in each argument of the function.
    needs_inputs : bool
        Whether results depend on inputs besides those that prescribe motions.
    returns_status : bool
        Whether the function may fail.
    """

    function: str
    watched: Watched | None
    results: Sequence[tuple[str, str, str] | None]
    per_argument: int
    needs_inputs: bool = False
    returns_status: bool = False


def _groups(layout: Layout, quantities: Sequence[str] = ()) -> list[_Group]:
    """What an FMU has besides states, parameters and inputs."""
    without, points = layout.potential_energy.without, list[tuple[str, str, str] | None]()
    potential = ("potential energy", f"without {', '.join(without)}" if without else "", "J")
    for point in layout.drawing.points:  # of those without a name, results are computed, but are no variables
        points += [(f"{point.name}.{axis}", f"position of {point.name}", "m") if point.name else None for axis in "xyz"]
    groups = [
        _Group("outputs", Watched.OUTPUT, [(name, "", "") for name in layout.outputs], len(layout.outputs), True, True),
        _Group(
            "energies",
            Watched.ENERGY,
            [("kinetic energy", "", "J"), potential if layout.potential_energy.is_known else None],
            1,
        ),
        _Group("points", None, points, len(points)),
    ]
    for role, vectors in QUANTITIES.items():
        results = [
            (name, f"{vector.description}, along the axis {name[-1]}", vector.unit)
            if vector.name in quantities
            else None
            for vector in vectors
            for name in vector.components
        ]
        groups.append(_Group(role.function, Watched.MOMENTUM, results, 3))
    return [group for group in groups if group.results]


def token_of(layout: Layout) -> str:
    """What ties a binary to its description."""
    return f"{{{layout.fingerprint[:32]}}}"


def variables_of(layout: Layout, defaults: Sequence[float], quantities: Sequence[str] = ()) -> list[Variable]:
    """The variables in the order of export/fmu.h.

    Parameters
    ----------
    layout : Layout
    defaults : sequence of float
        Values of the inputs at t = 0, NaN without one.
    quantities : sequence of str, optional
        Names of those of `QUANTITIES` whose components are outputs.

    Raises
    ------
    ModelError
        If two variables have the same name, or texts have characters that XML cannot have.
    """
    coordinates, speeds, states = layout.coordinates, layout.speeds, layout.states
    n_q, n_u = len(coordinates), len(speeds)
    dependent = {*coordinates[layout.n_independent_coordinates :], *speeds[layout.n_independent_speeds :]}
    initial = layout.initial
    found: list[Variable] = []

    def add(name: str, description: str, unit: str, kind: str, **more: Any) -> None:
        found.append(Variable(len(found), name, description, unit, kind, **more))

    add("time", "", "", "time")
    for k, name in enumerate(states):
        what = "coordinate" if k < n_q else "speed" if k < n_q + n_u else "state"
        words = f"{what}, follows from the independent ones" if name in dependent else what
        unit = "rad" if name in layout.angles else ""
        add(name, words, unit, "state", start=initial.get(name, 0.0), is_exact=name not in dependent)
    for k, name in enumerate(states):
        add(f"der({name})", "", "", "rate", of=1 + k)
    for p in layout.parameters:
        add(p.name, p.description, p.unit, "parameter", start=p.default)
    for entry, value in zip(layout.inputs, defaults, strict=True):
        words = f"{entry.expression}, until it is set" if entry.expression else ""
        if entry.order:
            words = ("", "rate of ", "second derivative of ")[entry.order] + entry.of
        add(entry.name, words, "", "input", start=0.0 if value != value else value)
    groups = _groups(layout, quantities)
    results = [(result, group.needs_inputs) for group in groups for result in group.results]
    found += [
        Variable(reference, *result, "output", needs_inputs=needs_inputs)
        for reference, (result, needs_inputs) in enumerate(results, len(found))
        if result is not None
    ]
    counts = Counter(variable.name for variable in found)
    for variable in found:
        _check(variable)
    twice = [name for name, number in counts.items() if number > 1]
    if twice:
        raise ModelError(f"Variables of an FMU have different names, but two are called {twice[0]!r}: rename one.")
    return found


def watched_variable(layout: Layout, variables: Sequence[Variable], name: str) -> tuple[int, Watched, int]:
    """The value reference of a state or output of an FMU by its name in Python, and what a library watches of it.

    Raises
    ------
    ModelError
        If no variable of the FMU has this name, or it is a position of a point.
    """
    names = {"kinetic_energy": "kinetic energy", "potential_energy": "potential energy"}
    own = names.get(name, name)
    begin = 1 + max(v.reference for v in variables if v.kind != "output")
    found = next((v for v in variables if v.name == own and v.kind in {"state", "output"}), None)
    if found is not None and found.kind == "state":
        return found.reference, Watched.STATE, found.reference - 1
    reference = -1 if found is None else found.reference
    for group in _groups(layout):
        if group.watched is not None and begin <= reference < begin + len(group.results):
            return reference, group.watched, reference - begin
        begin += len(group.results)
    known = [*layout.states, *layout.outputs, *names]
    raise ModelError(
        f"An event of an FMU is the name of one of its states, outputs, energies or momenta ({', '.join(known)}), not "
        f"{shown(name)}: make others an output of the model."
    )


def _check(variable: Variable) -> None:
    """Raise if a text of a variable has characters that XML cannot have; only descriptions may be of several lines."""
    for what, text, allowed in (
        ("name", variable.name, ""),
        ("unit", variable.unit, ""),
        ("description", variable.description, "\t\n\r"),
    ):
        wrong = re.search(f"[^{allowed}{XML_CHARACTERS}]", text)
        if wrong:
            of = "" if what == "name" else f" of {shown(variable.name)}"
            raise ModelError(
                f"The {what}{of} has the character U+{ord(wrong[0]):04X}, which the XML of an FMU cannot have: change "
                f"{shown(text)}."
            )


def description(
    fmi: int, layout: Layout, variables: Sequence[Variable], indicators: Sequence[Indicator], version: str
) -> str:
    """The file modelDescription.xml.

    Parameters
    ----------
    fmi : {2, 3}
    layout : Layout
    variables : sequence of Variable
    indicators : sequence of Indicator
    version : str
        Of fourbar_codegen.
    """
    name, token = layout.name, token_of(layout)
    root = ET.Element(
        "fmiModelDescription",
        {"fmiVersion": f"{fmi}.0", "modelName": name, "guid" if fmi == 2 else "instantiationToken": token},
        description=f"The mechanism {name}, with its loops closed",
        generationTool=f"fourbar_codegen {version}",
        variableNamingConvention="flat",
    )
    able = {"modelIdentifier": name, "providesDirectionalDerivative" + "s" * (fmi == 3): "true"}
    for word in ("canGetAndSetFMU", "canSerializeFMU"):
        able[f"{word}{'state' if fmi == 2 else 'State'}"] = "true"
    kinds = [
        ET.SubElement(root, "ModelExchange", able, **({"needsCompletedIntegratorStep": "true"} if fmi == 3 else {})),
        ET.SubElement(root, "CoSimulation", able, canHandleVariableCommunicationStepSize="true"),
    ]
    if indicators:
        if fmi == 2:
            root.set("numberOfEventIndicators", str(len(indicators)))
        else:
            kinds[1].set("mightReturnEarlyFromDoStep", "true")
    if fmi == 2:
        kinds[1].set("canInterpolateInputs", "true")
        for kind in kinds:
            files = ET.SubElement(kind, "SourceFiles")
            for source in sources_of(name):
                ET.SubElement(files, "File", name=source)
    units = sorted({variable.unit for variable in variables} - {""})
    if units:
        definitions = ET.SubElement(root, "UnitDefinitions")
        for unit in units:
            ET.SubElement(definitions, "Unit", name=unit)
    categories = ET.SubElement(root, "LogCategories")
    ET.SubElement(categories, "Category", name="logStatusError", description="Mistakes in calls, and failures")
    ET.SubElement(root, "DefaultExperiment", startTime="0", stopTime="1", tolerance="1e-6")
    listed = ET.SubElement(root, "ModelVariables")
    structure = ET.SubElement(root, "ModelStructure")
    for variable in variables:
        (_variable_2 if fmi == 2 else _variable_3)(listed, variable)
    outputs = [k for k, variable in enumerate(variables) if variable.kind in {"state", "output"}]
    rates = [k for k, variable in enumerate(variables) if variable.kind == "rate"]
    unknown = [
        k for k, v in enumerate(variables) if v.kind in {"rate", "output"} or (v.kind == "state" and not v.is_exact)
    ]
    depends = _dependencies(layout, variables)
    if fmi == 2:
        for element, numbers in (("Outputs", outputs), ("Derivatives", rates), ("InitialUnknowns", unknown)):
            group = ET.SubElement(structure, element)
            for number in numbers:
                own = {"index": str(number + 1)}
                if element == "Outputs" and number in depends:
                    own["dependencies"] = " ".join(str(place + 1) for place in depends[number])
                ET.SubElement(group, "Unknown", own)
    else:
        for element, numbers in (
            ("Output", outputs), ("ContinuousStateDerivative", rates), ("InitialUnknown", unknown)
        ):  # fmt: skip
            for number in numbers:
                own = {"valueReference": str(variables[number].reference)}
                if element == "Output" and number in depends:
                    own["dependencies"] = " ".join(str(variables[place].reference) for place in depends[number])
                ET.SubElement(structure, element, own)
        for indicator in indicators:
            ET.SubElement(structure, "EventIndicator", valueReference=str(indicator.reference))
    return _xml(root)


def _dependencies(layout: Layout, variables: Sequence[Variable]) -> dict[int, list[int]]:
    """For outputs that do not depend on all states and inputs, numbers of those that they depend on.

    Without them, importers would take speeds and positions as functions of the inputs, and see algebraic loops.
    """
    prescribed = {entry.name for entry in layout.inputs if entry.of in layout.has_rates}
    some = [k for k, v in enumerate(variables) if v.kind == "state" or (v.kind == "input" and v.name in prescribed)]
    found = {}
    for number, variable in enumerate(variables):
        if variable.kind == "state":
            found[number] = [number]
        elif variable.kind == "output" and not variable.needs_inputs:
            found[number] = some
    return found


def _common(variable: Variable) -> tuple[dict[str, str], dict[str, str]]:
    """Attributes that describe a variable, and those of its value."""
    own = {"name": variable.name, "valueReference": str(variable.reference)}
    if variable.description:
        own["description"] = variable.description
    match variable.kind:
        case "time":
            own |= {"causality": "independent", "variability": "continuous"}
        case "state":
            own |= {"causality": "output", "initial": "exact" if variable.is_exact else "approx"}
        case "rate":
            own |= {"causality": "local"}
        case "parameter":
            own |= {"causality": "parameter", "variability": "fixed"}
        case kind:
            own |= {"causality": kind}
    value = {"unit": variable.unit} if variable.unit else {}
    if variable.kind == "state":
        value["reinit"] = "true"  # at an event, onto the constraints
    if variable.start is not None:
        value["start"] = repr(float(variable.start))
    return own, value


def _variable_3(listed: ET.Element, variable: Variable) -> None:
    own, value = _common(variable)
    if variable.of is not None:
        value["derivative"] = str(variable.of)
    ET.SubElement(listed, "Float64", own | value)


def _variable_2(listed: ET.Element, variable: Variable) -> None:
    own, value = _common(variable)
    if variable.of is not None:
        value["derivative"] = str(variable.of + 1)  # the number of the state in the list, from 1
    ET.SubElement(ET.SubElement(listed, "ScalarVariable", own), "Real", value)


def sources_of(name: str) -> tuple[str, ...]:
    """The sources to compile."""
    return f"{name}.c", f"{name}_derivatives.c", f"{name}_stiff.c", f"{name}_fmu.c"


def build_description(name: str) -> str:
    """The file sources/buildDescription.xml of FMI 3.0."""
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = ET.SubElement(root, "BuildConfiguration", modelIdentifier=name)
    group = ET.SubElement(configuration, "SourceFileSet", language="C99")
    for source in sources_of(name):
        ET.SubElement(group, "SourceFile", name=source)
    return _xml(root)


def _xml(root: ET.Element) -> str:
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _results(layout: Layout) -> str:
    """The groups of results in C, in the order of their variables."""
    groups, name, cases = _groups(layout), layout.name, ""
    ends = list(itertools.accumulate(len(group.results) for group in groups))
    for number, (group, end) in enumerate(zip(groups, ends, strict=True)):
        places = range(end - len(group.results), end, group.per_argument)
        call = f"{name}_{group.function}(model, {', '.join(f'results + {place}' for place in places)})"
        cases += f"    case {number}: "
        cases += f"return {call};\n" if group.returns_status else f"{call}; break;\n"
    return f"""\
enum {{ FMU_N_RESULTS = {ends[-1]} }};
static const int fmu_ends[] = {{{", ".join(map(str, ends))}}}; /* of groups of results that are evaluated at once */
static int fmu_fill(struct {name} *model, const int group, double *results)
{{
    switch (group) {{
{cases}    }}
    return 0;
}}"""


def _events(name: str, indicators: Sequence[Indicator]) -> str:
    """The events in C."""
    rows = ",\n".join(
        f"    {{.quantity = {int(e.quantity)}, .number = {e.number}, .direction = {e.direction}, "
        f".terminal = {e.terminal}, .ends_only = {int(not e.all_roots)}, .at_start = {int(e.at_start)}}}"
        for _, e in indicators
    )
    references = ", ".join(str(indicator.reference) for indicator in indicators) or "0"
    return f"""\
enum {{ FMU_N_EVENTS = {len(indicators)} }};
static const unsigned fmu_indicators[] = {{{references}}}; /* their value references */
static const struct {name}_event fmu_events[] = {{
{rows or "    {0}"}
}};"""


def fmu_source(fmi: int, layout: Layout, method: str, indicators: Sequence[Indicator]) -> str:
    """The source of an FMU besides those of its library."""
    name = layout.name
    has_rates = ", ".join(str(int(not e.order and e.of in layout.has_rates)) for e in layout.inputs) or "0"
    return f"""\
/* The mechanism "{name}" as an FMU, generated by fourbar_codegen. Do not edit.
 *
 * {name}.h declares what is called here; export/fmu.h says how variables are numbered.
 */
#define FB_WITHOUT_TYPE
#include "{name}.h"

static const char fmu_token[] = "{token_of(layout)}";
enum {{ FMU_IS_STIFF = {int(method == STIFF)} }}; /* whether co-simulation is by Radau IIA, or else by a method */
static const int fmu_method = {name}_{"dop853" if method == STIFF else method.lower()};
static const int fmu_has_rates[] = {{{has_rates}}}; /* whether an input prescribes a motion, and its rates follow */

{_results(layout)}

{_events(name, indicators)}

#define FB_MODEL {name}
#include "{FOLDER}export/fmi{fmi}.h"
"""
