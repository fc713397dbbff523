"""Rounds: the exact exchange of strategy ``information``, term by term."""

from agents.protocol.rounds.protocol import RoundsProtocol

__all__ = ["RoundsProtocol"]
