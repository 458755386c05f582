"""Who may reach a service that starts: nobody by oversight."""

from __future__ import annotations

import logging
import ssl

from graspdb_service.commands.options import fail
from graspdb_service.settings import Settings, is_loopback
from graspdb_service.storage.access import keys
from graspdb_service.storage.database import Database

log = logging.getLogger("graspdb")

_MAKE_ONE = "graspdb-server keys create NAME --scopes admin (on the same GRASPDB_DATABASE_URL)"


def check_certificate(settings: Settings) -> None:
    """End in a line, rather than a traceback later, where TLS can't be spoken with what there is."""
    chain, key = settings.ssl_certfile, settings.ssl_keyfile
    if chain is None:
        return
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(chain, key)
    except (ssl.SSLError, OSError) as error:
        fail(f"No certificate and its key in {chain} and {key or 'the same file'}: {error}")


def check(settings: Settings, database: Database) -> None:
    """Refuse to open the database to a network by oversight, and warn of what was asked for."""
    beyond = not is_loopback(settings.host)
    if not settings.uses_keys:
        if beyond:
            names = ", ".join(("loopback", *settings.allowed_hosts))
            log.warning("without keys, all who reach %s may do all; Hosts served: %s", settings.host, names)
        return
    with database.read() as tx:
        openable = keys.any_usable(tx)
    if not openable and settings.auth is None:
        fail(
            f"Serving on {settings.host} takes keys, and there is none: make one with {_MAKE_ONE}."
            " Or listen on 127.0.0.1, or serve everybody and say so: --auth off (GRASPDB_AUTH=off)."
        )
    if not openable:
        log.warning("nobody has a key yet: %s", _MAKE_ONE)
    if beyond and settings.ssl_certfile is None:
        log.warning("keys come unencrypted unless a proxy before this speaks TLS (--ssl-certfile does)")
