"""STEP files in which each point, curve, surface and style stands once.

The CAD kernel writes the whole curve of every edge anew. Without the copies a file has less than half the size, and
readers find the same shapes.

Importing this module loads the CAD kernel (OCP): import it where it is used.
"""

# pyright: reportAttributeAccessIssue=false
# The CAD kernel's modules come without types.

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from OCP.APIHeaderSection import APIHeaderSection_MakeHeader
from OCP.BRep import BRep_Builder
from OCP.gp import gp_Trsf, gp_Vec
from OCP.IFSelect import IFSelect_ReturnStatus
from OCP.Interface import Interface_Static
from OCP.Message import Message, Message_Gravity
from OCP.Quantity import Quantity_Color
from OCP.STEPCAFControl import STEPCAFControl_Writer
from OCP.STEPControl import STEPControl_StepModelType
from OCP.TCollection import TCollection_ExtendedString, TCollection_HAsciiString
from OCP.TDataStd import TDataStd_Name
from OCP.TDocStd import TDocStd_Document
from OCP.TopLoc import TopLoc_Location
from OCP.TopoDS import TopoDS_Compound
from OCP.XCAFApp import XCAFApp_Application
from OCP.XCAFDoc import XCAFDoc_ColorType, XCAFDoc_DocumentTool
from OCP.XSControl import XSControl_WorkSession

from padforge.common.files import temporary_folder

_TIMESTAMP = "2000-01-01T00:00:00"
"""STEP files must carry a time; this one makes their bytes reproducible."""
_DIGITS = 6
"""Decimals of coordinates in mm: a nanometre."""
_SHARED = (
    *("CARTESIAN_POINT", "DIRECTION", "COLOUR_RGB", "DRAUGHTING_PRE_DEFINED_CURVE_FONT", "VECTOR"),
    *("AXIS2_PLACEMENT_3D", "LINE", "CIRCLE", "ELLIPSE", "PLANE", "CYLINDRICAL_SURFACE", "CONICAL_SURFACE"),
    *("B_SPLINE_CURVE_WITH_KNOTS", "SURFACE_OF_LINEAR_EXTRUSION", "CURVE_STYLE", "FILL_AREA_STYLE_COLOUR"),
    *("FILL_AREA_STYLE", "SURFACE_STYLE_FILL_AREA", "SURFACE_SIDE_STYLE", "SURFACE_STYLE_USAGE"),
    "PRESENTATION_STYLE_ASSIGNMENT",
)
"""Types of entities that stand once, each after those it refers to. Edges and faces that coincide stay apart."""
_ROUNDED = ("CARTESIAN_POINT", "B_SPLINE_CURVE_WITH_KNOTS")
_ENTITY = re.compile(r"#(\d+) ?= ?(.*?);\n", re.DOTALL)
_REFERENCE = re.compile(r"#(\d+)")
_LONG_NUMBER = re.compile(rf"-?\d+\.(?:\d{{{_DIGITS + 1},}}(?:E[-+]?\d+)?|\d*E[-+]?\d+)")
_STYLE = re.compile(
    "MECHANICAL_DESIGN_GEOMETRIC|OVER_RIDING_STYLED|STYLED_ITEM|CURVE_STYLE|FILL_AREA_STYLE|SURFACE_STYLE|SURFACE_SIDE_"
    "|PRESENTATION_STYLE|COLOUR_|DRAUGHTING_"
)
_STYLED_SHAPES = "MECHANICAL_DESIGN_GEOMETRIC_PRESENTATION_REPRESENTATION"


@dataclass(frozen=True)
class CadPart:
    """Named part of an assembly, or an assembly.

    Attributes:
        name: as CAD programs show it.
        colour: "#rrggbb", empty for an assembly.
        solids: the CAD kernel's solids (`TopoDS_Solid`), mm; none for an assembly.
        children: parts of an assembly.
        position_mm: x, y and z by which the part is moved within its assembly.
    """

    name: str
    colour: str = ""
    solids: tuple[Any, ...] = ()
    children: tuple["CadPart", ...] = ()
    position_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @cached_property
    def compound(self) -> TopoDS_Compound:
        """All solids as one shape of the kernel, children without their `position_mm`."""
        compound, builder = TopoDS_Compound(), BRep_Builder()
        builder.MakeCompound(compound)
        for shape in (*self.solids, *(child.compound for child in self.children)):
            builder.Add(compound, shape)
        return compound


def write_step(path: Path, part: CadPart) -> None:
    """Write an assembly with its names and colours as a STEP file, mm; the same bytes for the same shapes.

    Raises:
        OSError: the file cannot be written.
    """
    with temporary_folder(path.parent) as folder:
        raw = folder / "raw.step"
        if not export_xcaf(raw, part):
            raise OSError("the CAD kernel could not write it: is the disk full?")
        text = raw.read_text(encoding="utf-8")
    path.write_bytes(deduplicate(text).encode("utf-8"))


def export_xcaf(path: Path, part: CadPart) -> bool:
    """Write a STEP file by the CAD kernel's XCAF document; return whether it could be written."""
    for printer in Message.DefaultMessenger_s().Printers():
        printer.SetTraceLevel(Message_Gravity.Message_Fail)  # it reports its progress on stdout
    document = TDocStd_Document(TCollection_ExtendedString("XmlOcaf"))
    XCAFApp_Application.GetApplication_s().NewDocument(TCollection_ExtendedString("MDTV-XCAF"), document)
    XCAFDoc_DocumentTool.SetLengthUnit_s(document, 1e-3)
    shapes = XCAFDoc_DocumentTool.ShapeTool_s(document.Main())
    colours = XCAFDoc_DocumentTool.ColorTool_s(document.Main())
    shapes.SetAutoNaming_s(False)

    def add(part: CadPart) -> Any:
        label = shapes.NewShape() if part.children else shapes.AddShape(part.compound, False)
        TDataStd_Name.Set_s(label, TCollection_ExtendedString(part.name))
        for child in part.children:
            move = gp_Trsf()
            move.SetTranslation(gp_Vec(*child.position_mm))
            component = shapes.AddComponent(label, add(child), TopLoc_Location(move))
            TDataStd_Name.Set_s(component, TCollection_ExtendedString(child.name))
            if child.colour:
                colours.SetColor(component, _colour(child.colour), XCAFDoc_ColorType.XCAFDoc_ColorGen)
        if part.colour:
            colours.SetColor(label, _colour(part.colour), XCAFDoc_ColorType.XCAFDoc_ColorGen)
        return label

    add(part)
    shapes.UpdateAssemblies()
    writer = STEPCAFControl_Writer(XSControl_WorkSession(), False)
    header = APIHeaderSection_MakeHeader(0)
    header.Apply(writer.Writer().Model())
    header.SetName(TCollection_HAsciiString(part.name))
    header.SetTimeStamp(TCollection_HAsciiString(_TIMESTAMP))
    header.SetOriginatingSystem(TCollection_HAsciiString("padforge"))
    Interface_Static.SetIVal_s("write.surfacecurve.mode", 0)  # curves in the parameters of surfaces double the size
    writer.Transfer(document, STEPControl_StepModelType.STEPControl_AsIs)
    return writer.Write(str(path)) == IFSelect_ReturnStatus.IFSelect_RetDone


def deduplicate(text: str) -> str:
    """Return the kernel's STEP file with each entity of geometry and style once, its coordinates in few digits.

    Names have no brackets, semicolons or #. Shapes keep their order, styles follow in the order of the shapes.
    """
    head, _, body = text.partition("DATA;\n")
    data, _, tail = body.rpartition("ENDSEC;")
    entities: dict[str, str] = {}
    by_type: dict[str, list[str]] = {name: [] for name in _SHARED}
    for number, content in _ENTITY.findall(data):
        entities[number] = content = re.sub(r"\s*\n\s*", "", content) if "\n" in content else content
        numbers = by_type.get(content[: content.find("(")])
        if numbers is not None:
            numbers.append(number)

    first: dict[str, str] = {}  # content -> number of the first entity that has it
    shared: dict[str, str] = {}  # number -> number of the entity that replaces it
    placements = _assembly_placements(entities)

    def replace(match: re.Match[str]) -> str:
        return "#" + shared.get(match[1], match[1])

    for name, numbers in by_type.items():
        short: dict[str, str] = {}
        for number in numbers:
            content = entities[number]
            if name in _ROUNDED and content not in short:
                short[content] = _LONG_NUMBER.sub(_round, content)
            content = short.get(content, content)
            if "#" in content:
                content = _REFERENCE.sub(replace, content)
            entities[number] = content
            if number not in placements:
                shared[number] = first.setdefault(content, number)
    for number in [number for number, other in shared.items() if number != other]:
        del entities[number]

    order = _in_order(entities, shared)
    numbers = {number: f"#{position}" for position, number in enumerate(order, 1)}
    lines = "".join(f"#{number}={entities[number]};\n" for number in order)
    lines = _REFERENCE.sub(lambda match: numbers[shared.get(match[1], match[1])], lines)
    occurrences = iter(range(1, len(order)))  # the kernel counts them on from file to file
    lines = re.sub(r"(NEXT_ASSEMBLY_USAGE_OCCURRENCE\()'\d+'", lambda match: f"{match[1]}'{next(occurrences)}'", lines)
    return f"{head}DATA;\n{lines}ENDSEC;{tail}"


def _assembly_placements(entities: dict[str, str]) -> set[str]:
    """Numbers of the placements of an assembly's parts, which must stay several though they are equal."""
    users = re.compile(r"(?:SHAPE_REPRESENTATION|ITEM_DEFINED_TRANSFORMATION|ADVANCED_BREP_SHAPE_REPRESENTATION)\(")
    return {number for content in entities.values() if users.match(content) for number in _REFERENCE.findall(content)}


def _in_order(entities: dict[str, str], shared: dict[str, str]) -> list[str]:
    """Return the numbers of entities: shapes as written, then styles, which the kernel writes in no fixed order."""
    order: dict[str, None] = dict.fromkeys(number for number in entities if not _STYLE.match(entities[number]))
    rank = {number: position for position, number in enumerate(order)}

    def references(number: str) -> list[str]:
        return [shared.get(other, other) for other in _REFERENCE.findall(entities[number])]

    def shapes(number: str) -> list[int]:
        return [rank[other] for other in references(number) if other in rank]

    def add(number: str) -> None:
        if number not in order:
            order[number] = None
            for other in references(number):
                add(other)

    groups = [number for number, content in entities.items() if content.startswith(_STYLED_SHAPES)]
    for group in sorted(groups, key=shapes):
        *items, context = references(group)
        items.sort(key=lambda item: (entities[item].partition("(")[0], shapes(item)))
        entities[group] = f"{_STYLED_SHAPES}('',({','.join('#' + item for item in items)}),#{context})"
        add(group)
    return list(order)


def _round(match: re.Match[str]) -> str:
    short = f"{float(match[0]):.{_DIGITS}f}".rstrip("0")
    return "0." if short in ("-0.", "0.") else short


def _colour(colour: str) -> Quantity_Color:
    """A colour "#rrggbb" as the kernel has it, in linear RGB."""
    result = Quantity_Color()
    Quantity_Color.ColorFromHex_s(colour, result)
    return result
