"""Connection to an MQTT broker, for the source and for the sink. Needs aiomqtt, extra ``mqtt``."""

from __future__ import annotations

import ssl
from typing import Annotated, Any, Self

import aiomqtt
from pydantic import Field, model_validator

from coordinator.field.gateway.interface import MapPath
from dsse_core.files.bounded_file import read_text
from dsse_core.files.strict_table import Table

TIMEOUT_S = 10.0
KEEPALIVE_S = 10  # of silence; then the client pings the broker


class BrokerSettings(Table):
    """Address of the broker and credentials of the gateway there. ``password_file``: of one line. ``authority``,
    ``certificate``, ``key``: PEM; with ``authority`` or ``certificate`` the link is TLS.
    """

    host: str
    port: Annotated[int, Field(ge=1, le=65535)] | None = None
    username: str | None = None
    password_file: MapPath | None = None
    client_id: str | None = None
    tls: bool = False
    authority: MapPath | None = None
    certificate: MapPath | None = None
    key: MapPath | None = None

    @model_validator(mode="after")
    def _belongs_together(self) -> Self:
        if self.password_file and not self.username:
            raise ValueError("password_file needs username")
        if (self.certificate is None) != (self.key is None):
            raise ValueError("certificate and key belong together; give both, or neither")
        return self

    @property
    def is_secured(self) -> bool:
        return self.tls or self.authority is not None or self.certificate is not None


def connect(settings: BrokerSettings, **options: Any) -> aiomqtt.Client:
    """A client that connects to the broker when its block begins.

    Raises:
        InvalidInputError: the password file cannot be read.
        OSError: a certificate cannot be read.
    """
    password = read_text(settings.password_file).strip() if settings.password_file else None
    context = None
    if settings.is_secured:
        context = ssl.create_default_context(cafile=settings.authority)
        if settings.certificate:
            context.load_cert_chain(settings.certificate, settings.key)
    return aiomqtt.Client(
        settings.host,
        settings.port or (8883 if settings.is_secured else 1883),
        username=settings.username,
        password=password,
        identifier=settings.client_id,
        tls_context=context,
        timeout=TIMEOUT_S,
        keepalive=KEEPALIVE_S,
        **options,
    )
