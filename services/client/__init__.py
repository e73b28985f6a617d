"""A robot seen from another process: `Client` reads what is newest and asks its services."""

from services.client.client import SLOW_TIMEOUT, Client

__all__ = ["SLOW_TIMEOUT", "Client"]
