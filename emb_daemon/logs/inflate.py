"""Decompression of deflated data, bounded."""

import zlib

from emb_daemon.errors import InputError

try:
    # Four times as fast as zlib, where it is installed.
    from isal import isal_zlib as library
except ImportError:
    library = zlib


def inflate(packed: bytes | memoryview, window_bits: int, most_bytes: int) -> tuple[bytes, bool]:
    """Content of a stream, up to where it was cut off or to ``most_bytes``, and whether it is one complete stream.
    ``window_bits``: as of zlib; ``MAX_WBITS``, for gzip ``MAX_WBITS | 16``. Raises InputError: damaged."""
    unpacker = library.decompressobj(window_bits)
    try:
        content = unpacker.decompress(packed, most_bytes)
    except library.error as error:
        raise InputError(str(error)) from None
    return content, unpacker.eof and not unpacker.unused_data
