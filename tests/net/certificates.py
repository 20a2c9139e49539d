"""Certificates for one test: an authority, and a key of this machine that the authority has signed."""

import shutil
import subprocess
from pathlib import Path

import pytest

NAMES = "subjectAltName=DNS:localhost,IP:127.0.0.1"


class Certificates:
    def __init__(self, folder: Path) -> None:
        self.authority, self.certificate, self.key = (
            folder / name for name in ("ca.pem", "machine.pem", "machine.key")
        )
        if shutil.which("openssl") is None:
            pytest.skip("there is no openssl to make certificates with")
        request = folder / "machine.csr"
        extension = folder / "machine.ext"
        extension.write_text(NAMES)
        new = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
        run_openssl(
            "req",
            "-x509",
            *new,
            "-days",
            "2",
            "-subj",
            "/CN=trilat test authority",
            "-keyout",
            folder / "ca.key",
            "-out",
            self.authority,
        )
        run_openssl("req", *new, "-subj", "/CN=machine", "-keyout", self.key, "-out", request)
        run_openssl(
            "x509",
            "-req",
            "-in",
            request,
            "-days",
            "2",
            "-CA",
            self.authority,
            "-CAkey",
            folder / "ca.key",
            "-CAcreateserial",
            "-extfile",
            extension,
            "-out",
            self.certificate,
        )

    def zenoh_file(self) -> Path:
        file = self.authority.with_name("zenoh.json5")
        file.write_text(
            f"""{{ transport: {{ link: {{ tls: {{ // both show a certificate of the same authority
                root_ca_certificate: "{self.authority}", enable_mtls: true,
                listen_certificate: "{self.certificate}", listen_private_key: "{self.key}",
                connect_certificate: "{self.certificate}", connect_private_key: "{self.key}",
            }} }} }} }}"""
        )
        return file


def run_openssl(*arguments: str | Path) -> None:
    subprocess.run(["openssl", *arguments], check=True, capture_output=True, timeout=30)
