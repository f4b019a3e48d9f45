"""An enveloped XML signature of a certificate, with the user's key; needs the extra `sign` (signxml)."""

from __future__ import annotations

import importlib
from types import ModuleType

from tvsbayes.errors import InputError

EXTRA = "install the extra: `pip install 'tvsbayes[sign]'`"


def _library(name: str) -> ModuleType:
    """A library of the extra.

    Raises:
        InputError: it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError("no-signxml", f"--sign needs {name}", remedy=EXTRA) from error


def require_signer() -> None:
    """Check that the extra is installed.

    Raises:
        InputError: it is not.
    """
    for name in ("signxml", "lxml.etree"):
        _library(name)


def signed_xml(data: bytes, key_pem: bytes, certificate_pem: bytes) -> bytes:
    """Sign a document as a whole (XMLDSig, enveloped, SHA-256); the signature is its last child, as the DCC has it.

    Args:
        data: the document.
        key_pem: the private key, PEM without a password.
        certificate_pem: the X.509 certificate of the key, PEM; it goes into the signature.

    Raises:
        InputError: the extra is not installed, or key and certificate cannot be used or do not belong together.
    """
    signxml, etree = _library("signxml"), _library("lxml.etree")
    try:
        signer = signxml.XMLSigner(method=signxml.methods.enveloped, signature_algorithm=_algorithm(key_pem))
        root = signer.sign(_parsed(etree, data), key=key_pem, cert=certificate_pem.decode("ascii"))
        result: bytes = etree.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n"
        verify_signature(result, certificate_pem)
    except InputError:
        raise
    except Exception as error:
        # Messages of the library may quote a key: only its kind is said.
        message = f"the key and the certificate cannot sign: {type(error).__name__}"
        remedy = "give the PEM of an RSA or EC key without a password, and the PEM of its own certificate"
        raise InputError("bad-key", message, allowed="a private key and its certificate, PEM", remedy=remedy) from None
    return result


def _algorithm(key_pem: bytes) -> str:
    """The algorithm of the key's kind: only those on curves have one."""
    serialization = _library("cryptography.hazmat.primitives.serialization")
    key = serialization.load_pem_private_key(key_pem, password=None)
    return "ecdsa-sha256" if hasattr(key, "curve") else "rsa-sha256"


def _parsed(etree: ModuleType, data: bytes) -> object:
    return etree.fromstring(data, etree.XMLParser(no_network=True, resolve_entities=False, huge_tree=True))


def verify_signature(data: bytes, certificate_pem: bytes) -> None:
    """Check that a document is signed by the key of a certificate, and unchanged.

    Raises:
        InputError: it is not, or the extra is not installed.
    """
    signxml, etree = _library("signxml"), _library("lxml.etree")
    try:
        signxml.XMLVerifier().verify(_parsed(etree, data), x509_cert=certificate_pem.decode("ascii"))
    except Exception as error:
        message = f"the signature does not hold: {type(error).__name__}"
        raise InputError("bad-signature", message, remedy="sign it again, with the key of this certificate") from None
