"""STEP files of CAD models: an assembly of named and coloured parts, mm, with the same bytes for the same shapes.

The kernel's writer of colours orders them by the addresses of shapes, which differ from run to run. build123d's export
repeats every point at each use, which makes files half as large again.
"""

# pyright: reportAttributeAccessIssue=false
# The CAD kernel's modules come without types.

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from build123d import Compound, Solid
from OCP.APIHeaderSection import APIHeaderSection_MakeHeader
from OCP.collections import HArray1_StepRepr_RepresentationItem
from OCP.IFSelect import IFSelect_ReturnStatus
from OCP.Interface import Interface_Static
from OCP.Message import Message, Message_Gravity
from OCP.STEPCAFControl import STEPCAFControl_Writer
from OCP.STEPConstruct import STEPConstruct_RenderingProperties, STEPConstruct_Styles
from OCP.STEPControl import STEPControl_Controller, STEPControl_StepModelType
from OCP.StepRepr import StepRepr_NextAssemblyUsageOccurrence
from OCP.StepVisual import StepVisual_MechanicalDesignGeometricPresentationRepresentation
from OCP.TCollection import TCollection_ExtendedString, TCollection_HAsciiString
from OCP.TDataStd import TDataStd_Name
from OCP.TDF import TDF_Label
from OCP.TDocStd import TDocStd_Document
from OCP.XCAFApp import XCAFApp_Application
from OCP.XCAFDoc import XCAFDoc_DocumentTool, XCAFDoc_ShapeTool
from OCP.XSControl import XSControl_WorkSession


def write_step(path: Path, shape: Compound | Solid) -> None:
    """Write a solid, or an assembly whose leaves are solids, with the names and colours of its parts."""
    for printer in Message.DefaultMessenger_s().Printers():
        printer.SetTraceLevel(Message_Gravity.Message_Fail)
    STEPControl_Controller.Init_s()
    Interface_Static.SetIVal_s("write.surfacecurve.mode", 0)  # curves on surfaces double the size
    document = TDocStd_Document(TCollection_ExtendedString("XmlOcaf"))
    XCAFApp_Application.GetApplication_s().NewDocument(TCollection_ExtendedString("MDTV-XCAF"), document)
    XCAFDoc_DocumentTool.SetLengthUnit_s(document, 1e-3)
    parts = list(_add_parts(XCAFDoc_DocumentTool.ShapeTool_s(document.Main()), shape))
    session = XSControl_WorkSession()
    step = STEPCAFControl_Writer(session, False)
    step.SetColorMode(False)
    step.Transfer(document, STEPControl_StepModelType.STEPControl_AsIs)
    writer = step.ChangeWriter()
    _add_colours(STEPConstruct_Styles(session), writer.Model(), parts)
    _number_components(writer.Model())
    writer.CleanDuplicateEntities()
    header = APIHeaderSection_MakeHeader(0)
    header.SetName(TCollection_HAsciiString(shape.label))
    header.SetTimeStamp(TCollection_HAsciiString("2000-01-01T00:00:00"))  # a constant, for reproducible bytes
    header.SetOriginatingSystem(TCollection_HAsciiString("padforge"))
    header.Apply(writer.Model())
    if step.Write(str(path)) != IFSelect_ReturnStatus.IFSelect_RetDone:
        raise OSError("the CAD kernel could not write it: is the disk full?")


def _add_parts(tool: Any, node: Any, parent: TDF_Label | None = None) -> Iterator[tuple[Any, Any]]:
    """Add a node and its children to a document; yield the shape and the colour of every leaf that has one."""
    if parent is None:
        label = product = tool.AddShape(node.wrapped, False)
    else:
        label, product = tool.AddComponent(parent, node.wrapped), TDF_Label()
        XCAFDoc_ShapeTool.GetReferredShape_s(label, product)
    for named in (label, product):
        TDataStd_Name.Set_s(named, TCollection_ExtendedString(node.label))
    for child in node.children:
        yield from _add_parts(tool, child, product)
    if parent is None:
        tool.UpdateAssemblies()
    if node.color is not None and not node.children:
        yield XCAFDoc_ShapeTool.GetShape_s(product), node.color.wrapped.GetRGB()


def _add_colours(styles: STEPConstruct_Styles, model: Any, parts: list[tuple[Any, Any]]) -> None:
    """Add the colours of parts to the model of a STEP file, in their order."""
    for shape, colour in parts:
        encoded = STEPConstruct_Styles.EncodeColor_s(colour)
        assignment = styles.MakeColorPSA(None, encoded, None, STEPConstruct_RenderingProperties())
        items = HArray1_StepRepr_RepresentationItem(1, 1)
        items.SetValue(1, styles.AddStyle(shape, assignment, None))
        presentation = StepVisual_MechanicalDesignGeometricPresentationRepresentation()
        presentation.Init(TCollection_HAsciiString(""), items, styles.FindContext(shape))
        model.AddWithRefs(presentation)


def _number_components(model: Any) -> None:
    """Number the components of assemblies from 1; the kernel continues the numbers of earlier files."""
    number = 0
    for index in range(1, model.NbEntities() + 1):
        if isinstance(entity := model.Value(index), StepRepr_NextAssemblyUsageOccurrence):
            number += 1
            entity.SetId(TCollection_HAsciiString(str(number)))
