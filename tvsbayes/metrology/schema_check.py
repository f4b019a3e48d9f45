"""A certificate held against the schema that its reader names, on this machine, without any network."""

from __future__ import annotations

import importlib
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

from tvsbayes.errors import InputError, escaped

XSD_SECONDS = 60


@dataclass(frozen=True)
class SchemaCheck:
    """What a schema validator said: `valid` is None where nothing could be checked, and `messages` say why."""

    tool: str | None
    valid: bool | None
    messages: tuple[str, ...]


def check_dcc(data: bytes, schema: Path) -> SchemaCheck:
    """Validate a certificate against the schema that the user names.

    xmllint where it is installed, else lxml; neither is a dependency. PTB's schema loads D-SI by URL: point to a folder
    in which the imports are relative paths.

    Args:
        data: of `dcc_bytes`.
        schema: `dcc.xsd`.

    Raises:
        InputError: there is no such file.
    """
    if not Path(schema).is_file():
        raise InputError(
            "missing-file",
            f"{escaped(str(schema), 200)}: no such file",
            file=escaped(str(schema), 200),
            remedy="give the path of dcc.xsd",
        )
    xmllint = shutil.which("xmllint")
    return _by_lxml(data, schema) if xmllint is None else _by_xmllint(xmllint, data, schema)


def _by_xmllint(program: str, data: bytes, schema: Path) -> SchemaCheck:
    command = [program, "--nonet", "--noout", "--schema", str(Path(schema).resolve()), "-"]
    try:
        done = subprocess.run(command, input=data, capture_output=True, timeout=XSD_SECONDS, check=False)
    except subprocess.TimeoutExpired:
        return SchemaCheck("xmllint", None, (f"no answer within {XSD_SECONDS} s",))
    messages = tuple(done.stderr.decode("utf-8", "replace").strip().splitlines())
    # 0 valid, 3 and 4 not valid; else the schema itself could not be used (xmllint(1), "Diagnostics").
    return SchemaCheck("xmllint", {0: True, 3: False, 4: False}.get(done.returncode), messages)


def _by_lxml(data: bytes, schema: Path) -> SchemaCheck:
    try:
        etree = importlib.import_module("lxml.etree")
    except ImportError:
        return SchemaCheck(None, None, ("not checked: install xmllint (libxml2) or lxml to validate",))
    parser = etree.XMLParser(no_network=True, resolve_entities=False)
    try:
        checker = etree.XMLSchema(etree.parse(str(schema), parser))
    except (etree.XMLSchemaParseError, etree.XMLSyntaxError) as error:
        return SchemaCheck("lxml", None, (str(error),))
    valid = bool(checker.validate(etree.fromstring(data, parser)))
    return SchemaCheck("lxml", valid, tuple(str(entry) for entry in checker.error_log))
