"""Certificates against the user's own schema."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest
from support.certified_campaign import certified

from tvsbayes.errors import InputError
from tvsbayes.metrology.schema_check import check_dcc

SMALL_XSD = """<xs:schema xmlns:xs="http://www.w3.org/2001/XMLSchema" xmlns:dcc="https://ptb.de/dcc"
 targetNamespace="https://ptb.de/dcc" elementFormDefault="qualified">
<xs:element name="digitalCalibrationCertificate"><xs:complexType><xs:sequence>
<xs:any maxOccurs="unbounded" processContents="skip"/></xs:sequence>
<xs:attribute name="schemaVersion" type="xs:string" fixed="VERSION"/></xs:complexType></xs:element></xs:schema>"""


def test_a_schema_that_the_user_names_is_used(tmp_path, monkeypatch):
    data = certified().certificate()
    right, wrong, broken = (tmp_path / name for name in ("right.xsd", "wrong.xsd", "broken.xsd"))
    right.write_text(SMALL_XSD.replace("VERSION", "3.3.0"))
    wrong.write_text(SMALL_XSD.replace("VERSION", "2.4.0"))
    broken.write_text("<nothing/>")
    with pytest.raises(InputError, match="no such file"):
        check_dcc(data, tmp_path / "missing.xsd")
    for hidden in (False, True):
        if hidden:
            monkeypatch.setattr(shutil, "which", lambda name: None)
        found = check_dcc(data, right)
        if found.tool is None:
            assert found.valid is None and "install xmllint" in found.messages[0]
            continue
        assert found.valid is True
        assert check_dcc(data, wrong).valid is False and check_dcc(data, wrong).messages
        assert check_dcc(data, broken).valid is None
    monkeypatch.setattr(shutil, "which", lambda name: "xmllint")
    answers = {
        "timeout": subprocess.TimeoutExpired("xmllint", 60),
        "valid": SimpleNamespace(returncode=0, stderr=b"- validates\n"),
        "invalid": SimpleNamespace(returncode=3, stderr=b"a\nb\n"),
        "schema": SimpleNamespace(returncode=5, stderr=b"failed to compile\n"),
    }

    def answer(kind):
        def run(command, **options):
            assert "--nonet" in command and options["input"] == data
            if isinstance(answers[kind], Exception):
                raise answers[kind]
            return answers[kind]

        return run

    for kind, valid in (("timeout", None), ("valid", True), ("invalid", False), ("schema", None)):
        monkeypatch.setattr(subprocess, "run", answer(kind))
        found = check_dcc(data, right)
        assert (found.tool, found.valid) == ("xmllint", valid) and found.messages


@pytest.mark.skipif("TVSBAYES_DCC_SCHEMA" not in os.environ, reason="TVSBAYES_DCC_SCHEMA names no dcc.xsd")
def test_ptbs_schema_where_it_is_at_hand():
    data = certified().with_positioning().certificate(report=b"<html/>")
    found = check_dcc(data, Path(os.environ["TVSBAYES_DCC_SCHEMA"]))
    assert found.valid is True, found
