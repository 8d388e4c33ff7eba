"""File formats: one a file, each with a reader and a writer; `read` and `write` choose by extension."""

from factored_polca.formats.document import Document
from factored_polca.formats.files import FORMATS, Format, destination, format_of, read, write
from factored_polca.formats.native import read_native, template, write_native

__all__ = [
    "FORMATS", "Document", "Format", "destination", "format_of", "read", "read_native", "template", "write",
    "write_native",
]  # fmt: skip
