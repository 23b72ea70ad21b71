"""The artifact store: keys, manifests, atomic publishing, checkpoints, locks, garbage."""

from slomo.store.artifacts import SCHEMA, Manifest, Store
from slomo.store.digest import digest_input, digest_json, plain
from slomo.store.files import json_bytes, read_json, remove, replace_file, size_of, writing

__all__ = [
    "SCHEMA",
    "Manifest",
    "Store",
    "digest_input",
    "digest_json",
    "json_bytes",
    "plain",
    "read_json",
    "remove",
    "replace_file",
    "size_of",
    "writing",
]
