"""A signed certificate holds with its own key, unchanged, and in no other case."""

from __future__ import annotations

import sys
import xml.etree.ElementTree as ET

import pytest
from support.certified_campaign import certified
from support.dcc_structure import local, structure_problems
from support.refusals import refusal
from support.signers import signer

from tvsbayes.metrology.signature import require_signer, signed_xml, verify_signature

pytest.importorskip("signxml")


@pytest.mark.parametrize("kind", ["ec", "rsa"])
def test_a_signature_holds_for_the_document_alone(kind):
    key, public = signer(kind)
    data = certified().certificate(signed=True)
    signed = signed_xml(data, key, public)
    verify_signature(signed, public)
    root = ET.fromstring(signed)
    # Last of the children, as the schema has it; nothing else changed.
    assert local(root[-1]) == "Signature" and root[-1].tag.startswith("{http://www.w3.org/2000/09/xmldsig#}")
    root.remove(root[-1])
    assert structure_problems(root) == []
    assert "true" in [e.text for e in root.iter() if local(e) == "cryptElectronicSignature"]
    changed = signed.replace(b"B-17", b"B-18", 1)
    assert changed != signed and refusal(lambda: verify_signature(changed, public)).code == "bad-signature"
    assert refusal(lambda: verify_signature(signed, signer(kind)[1])).code == "bad-signature"
    assert refusal(lambda: verify_signature(data, public)).code == "bad-signature"


def test_a_key_of_another_certificate_is_refused_and_never_shown():
    key, public = signer()
    for wrong in (signer()[0], b"-----BEGIN PRIVATE KEY-----\nsecret\n-----END PRIVATE KEY-----\n", b""):
        error = refusal(lambda wrong=wrong: signed_xml(certified().certificate(), wrong, public))
        assert error.code in ("bad-key", "bad-signature") and "secret" not in str(error)
    assert refusal(lambda: signed_xml(certified().certificate(), key, b"no PEM")).code == "bad-key"


def test_without_the_extra_it_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "signxml", None)
    assert "tvsbayes[sign]" in refusal(require_signer).remedy
