"""Helpers, not part of the public interface: atomic files, worker processes, untrusted files."""
