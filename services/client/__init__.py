"""Client of a robot in another process: it reads the newest messages and queries services."""

from services.client.client import SLOW_TIMEOUT, Client

__all__ = ["SLOW_TIMEOUT", "Client"]
