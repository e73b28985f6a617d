"""Client of a robot in another process: it reads the newest messages and queries services."""

from services.client.client import SLOW_TIMEOUT, Client
from services.client.emergency import emergency_stop

__all__ = ["SLOW_TIMEOUT", "Client", "emergency_stop"]
