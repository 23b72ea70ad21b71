"""Starting Warp without its greeting."""

import os

import warp as wp


def init() -> None:
    """Start Warp without its greeting, nor its library's warning of a missing GPU driver: the CPU serves as well."""
    wp.config.log_level = wp.LOG_ERROR
    stderr, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)
    try:
        wp.init()
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
        os.close(null)
