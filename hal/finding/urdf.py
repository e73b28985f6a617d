"""A URDF as XML: like the parser of ROS it takes no notice of namespaces, and of space before the declaration."""

import xml.etree.ElementTree as ElementTree
from xml.etree.ElementTree import Element
from xml.parsers import expat


def root_of(text: str | bytes) -> Element:
    """Return the root element; names with a prefix that is declared nowhere (`drake:acceleration`) keep it.

    Raises:
        ElementTree.ParseError: It is not XML.
    """
    text = text.lstrip()
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        if error.code != expat.errors.codes[expat.errors.XML_ERROR_UNBOUND_PREFIX]:
            raise
    builder, parser = ElementTree.TreeBuilder(), expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    try:
        parser.Parse(text, True)
    except expat.ExpatError as error:
        raise ElementTree.ParseError(str(error)) from None
    return builder.close()


def drop_extensions(element: Element) -> None:
    """Remove elements and attributes with a prefix that is declared nowhere; they would be no XML in another file."""
    for name in [name for name in element.attrib if _is_undeclared(name)]:
        del element.attrib[name]
    for child in list(element):
        if _is_undeclared(child.tag):
            element.remove(child)
        else:
            drop_extensions(child)


def _is_undeclared(name: str) -> bool:
    return ":" in name and not name.startswith("{")
