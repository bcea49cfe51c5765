"""Policy servers behind TLS (`wss://`), with certificates that are made on the spot."""

import datetime
import socket
import ssl
import threading
import time
from collections.abc import Iterator
from ipaddress import ip_address
from pathlib import Path

import pytest
from support.messages import raises
from support.policy_calls import INFER, RESET, added, rollout
from support.policy_server import PolicyServer

from robomme_interference_data.errors import PolicyServerError
from robomme_interference_data.evaluate.policies.registry import make_policy

x509 = pytest.importorskip("cryptography.x509")


def make_certificate(folder: Path, address: str = "127.0.0.1") -> tuple[Path, Path]:
    """Write a certificate that signs itself, and its key; return their paths."""
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.oid.NameOID.COMMON_NAME, "a policy server")])
    now = datetime.datetime.now(datetime.UTC)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now - datetime.timedelta(hours=1))
        .not_valid_after(now + datetime.timedelta(hours=1))
        .add_extension(x509.SubjectAlternativeName([x509.IPAddress(ip_address(address))]), False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), True)
        .sign(key, hashes.SHA256())
    )
    public, private = folder / "certificate.pem", folder / "key.pem"
    public.write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    private.write_bytes(
        key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        )
    )
    return public, private


@pytest.fixture
def secure(tmp_path: Path) -> Iterator[PolicyServer]:
    """A policy server with TLS; its certificate is `tmp_path / "certificate.pem"`."""
    server = PolicyServer()
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(*make_certificate(tmp_path))
    server.options["ssl"] = context
    with server.running() as running:
        yield running


def test_a_rollout(secure: PolicyServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / "certificate.pem"))
    policy = make_policy(f"websocket:wss://127.0.0.1:{secure.port}")
    rollout(policy, 16, [16], [2])
    assert secure.calls == [RESET, added(16, 16), added(1, 16), INFER, added(2, 0), INFER]
    assert policy.metadata()["server"] == f"wss://127.0.0.1:{secure.port}"
    policy.close()


def test_a_certificate_that_nobody_trusts(secure: PolicyServer) -> None:
    with raises(PolicyServerError) as caught:
        make_policy(f"websocket:wss://127.0.0.1:{secure.port}").metadata()
    assert "SSL_CERT_FILE" in str(caught.value.hint)


def test_a_certificate_of_another_host(
    secure: PolicyServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / "certificate.pem"))
    with raises(PolicyServerError):
        make_policy(f"websocket:wss://localhost:{secure.port}").metadata()


def test_a_server_without_tls(server: PolicyServer) -> None:
    """It waits for the end of what it takes for a request, or closes the connection."""
    with pytest.raises(PolicyServerError):
        make_policy(f"websocket:wss://127.0.0.1:{server.port}", ["connect_s=0.2"]).metadata()


def test_a_server_that_answers_without_tls() -> None:
    def answer(listening: socket.socket) -> None:
        connection, _ = listening.accept()
        with connection:
            connection.recv(1 << 16)
            connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")

    with socket.create_server(("127.0.0.1", 0)) as listening:
        threading.Thread(target=answer, args=[listening], daemon=True).start()
        with raises(PolicyServerError):
            make_policy(f"websocket:wss://127.0.0.1:{listening.getsockname()[1]}").metadata()


def test_a_slow_answer_ends(
    secure: PolicyServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / "certificate.pem"))
    policy = make_policy(f"websocket:wss://127.0.0.1:{secure.port}", ["response_s=0.3"])
    secure.before = lambda message: time.sleep(1)
    with raises(PolicyServerError):
        rollout(policy, 0, [], [])
    policy.close()
