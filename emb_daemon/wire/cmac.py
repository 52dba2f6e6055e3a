"""AES-128-CMAC in compiled code; each code takes constant time.

Sources: FIPS 197 (AES), RFC 4493 (CMAC). A state of 16 bytes is held bit-sliced: word i consists of bit i of all bytes, byte n
at bit n. The S-box is then Boolean arithmetic, and no address or branch depends on the key or on a message. With a table,
other processes of the machine could find out through the cache which of its lines were read; a table is used only once, at the
start, for the round keys. The inverse in the S-box is computed in the tower GF(((2^2)^2)^2) with w^2 = w + 1, x^2 = x + w + 1,
y^2 = y + wx + w; the change of basis was found by search.
"""

import numpy as np

from emb_daemon.jit import Bytes, Record, entry, njit

#: ``rounds``: the eleven round keys; ``last``: the subkeys K1 and K2 of CMAC; ``state``: of a calculation; all bit-sliced.
KEY = np.dtype([("rounds", "i8", (11, 8)), ("last", "i8", (2, 8)), ("state", "i8", (8,))], align=True)

#: What the S-box adds to every byte. It passes through the rest of a round unchanged, so it is added with the round key.
_ADDED = 0x63


@njit
def _product(a3, a2, a1, a0, b3, b2, b1, b0):
    """Product of two elements of GF(16), highest bit first."""
    p2, p1, p0 = (a3 ^ a2) & (b3 ^ b2), a3 & b3, a2 & b2
    q2, q1, q0 = (a1 ^ a0) & (b1 ^ b0), a1 & b1, a0 & b0
    a3, a2, b3, b2 = a3 ^ a1, a2 ^ a0, b3 ^ b1, b2 ^ b0
    r2, r1, r0 = (a3 ^ a2) & (b3 ^ b2), a3 & b3, a2 & b2
    high, low = q2 ^ q0, q1 ^ q0
    return r2 ^ r0 ^ high, r1 ^ r0 ^ low, high ^ p1 ^ p0, low ^ p2 ^ p1


@njit
def _substitute(q):
    """SubBytes, without `_ADDED`."""
    q0, q1, q2, q3, q4, q5, q6, q7 = int(q[0]), int(q[1]), int(q[2]), int(q[3]), int(q[4]), int(q[5]), int(q[6]), int(q[7])
    # To the tower: c y + d.
    s23, s57 = q2 ^ q3, q5 ^ q7
    s156 = q6 ^ q1 ^ q5
    c3, c2, c1, c0 = s57, q4 ^ s23 ^ s156, s23 ^ s57, q1
    d3, d2, d1, d0 = q2 ^ q4, q2 ^ q7, q1 ^ q7, q0 ^ s156
    # Its norm (wx + w) c^2 + c d + d^2, an element of GF(16).
    n3, n2, n1, n0 = _product(c3, c2, c1, c0, d3, d2, d1, d0)
    n3 ^= c0 ^ c3 ^ d3
    n2 ^= c1 ^ c2 ^ c3 ^ d2 ^ d3
    n1 ^= c0 ^ d1 ^ d2 ^ d3
    n0 ^= c1 ^ d0 ^ d1 ^ d2
    # The inverse of the norm, by the inverse of its own norm, which is its square in GF(4).
    p, r, s = n3 & n1, n2 & n0, (n3 ^ n2) & (n1 ^ n0)
    i1 = n3 ^ n2 ^ n1 ^ s ^ r
    i0 = n2 ^ n1 ^ n0 ^ p ^ r ^ i1
    m1, m0, i10 = n3 ^ n1, n2 ^ n0, i1 ^ i0
    p, r, s = n3 & i1, n2 & i0, (n3 ^ n2) & i10
    e3, e2 = s ^ r, p ^ r
    p, r, s = m1 & i1, m0 & i0, (m1 ^ m0) & i10
    e1, e0 = s ^ r, p ^ r
    u7, u6, u5, u4 = _product(c3, c2, c1, c0, e3, e2, e1, e0)
    u3, u2, u1, u0 = _product(c3 ^ d3, c2 ^ d2, c1 ^ d1, c0 ^ d0, e3, e2, e1, e0)
    # Back from the tower and through the affine map at once.
    s04, s23, s46 = u0 ^ u4, u2 ^ u3, u4 ^ u6
    s014, s046 = u1 ^ s04, u6 ^ s04
    q[0], q[1], q[2], q[3] = s04 ^ s23, s014, u2 ^ u7 ^ s014, s23 ^ s046
    q[4], q[5], q[6], q[7] = s046, u4 ^ u5 ^ s23, s46, u2 ^ s46


@njit
def _shift_rows(q):
    """Byte n is in row n % 4; row r moves by r columns."""
    for i in range(8):
        a = int(q[i])
        twice = a | a << 16
        q[i] = a & 0x1111 | twice >> 4 & 0x2222 | twice >> 8 & 0x4444 | twice >> 12 & 0x8888


@njit
def _mix_columns(q):
    high = 0
    for i in range(8):
        # Each byte plus the next one of its column is doubled: the bits move up by one word, the highest to where 0x1B has
        # ones.
        a = int(q[i])
        next_one = a >> 1 & 0x7777 | a << 3 & 0x8888
        both = a ^ next_one
        q[i] = high ^ next_one ^ (both >> 2 & 0x3333 | both << 2 & 0xCCCC)
        high = both
    for i in (0, 1, 3, 4):
        q[i] ^= high


@njit
def _encrypt(key):
    """Encrypt the state."""
    q = key.state
    for i in range(8):
        q[i] ^= key.rounds[0, i]
    for number in range(1, 11):
        _substitute(q)
        _shift_rows(q)
        if number < 10:
            _mix_columns(q)
        for i in range(8):
            q[i] ^= key.rounds[number, i]


@njit
def _transpose(x):
    """Transpose eight bytes: bit i of byte n becomes bit n of byte i."""
    swapped = (x ^ x >> 7) & 0x00AA00AA00AA00AA
    x ^= swapped ^ swapped << 7
    swapped = (x ^ x >> 14) & 0x0000CCCC0000CCCC
    x ^= swapped ^ swapped << 14
    swapped = (x ^ x >> 28) & 0x00000000F0F0F0F0
    return x ^ swapped ^ swapped << 28


@njit
def _eight(message, start, length):
    """Eight bytes of the padded message, transposed."""
    word = 0
    for n in range(8):
        at = start + n
        word |= (int(message[at]) if at < length else 0x80 if at == length else 0) << 8 * n
    return _transpose(word)


@njit
def cmac(key: Record, message: Bytes, length: int, code: Bytes) -> None:
    """Write the 16 bytes of the code of ``message[:length]`` to ``code``. ``key``: a KEY record of `new_key`."""
    q, start, more = key.state, 0, True
    q[:] = 0
    while more:
        more = length - start > 16
        low, high = _eight(message, start, length), _eight(message, start + 8, length)
        for i in range(8):
            q[i] ^= low >> 8 * i & 0xFF | (high >> 8 * i & 0xFF) << 8
            if not more:
                q[i] ^= key.last[0 if length - start == 16 else 1, i]
        _encrypt(key)
        start += 16
    for half in range(2):
        word = 0
        for i in range(8):
            word |= (int(q[i]) >> 8 * half & 0xFF) << 8 * i
        word = _transpose(word)
        for n in range(8):
            code[8 * half + n] = word >> 8 * n & 0xFF


@entry(KEY)
def _add_subkeys(key):
    """K1 and K2: the encrypted zero block, multiplied by x and by x^2; a block's first bit is the highest of byte 0."""
    key.state[:] = 0
    _encrypt(key)
    for which in range(2):
        before = key.state
        for i in range(8):
            # The highest bit of the next byte becomes the lowest.
            key.last[which, i] = before[i - 1] if i > 0 else before[7] >> 1
        # A bit that leaves the block comes back as 0x87 in its last byte.
        for i in (0, 1, 2, 7):
            key.last[which, i] ^= (before[7] & 1) << 15
        for i in range(8):
            before[i] = key.last[which, i]


def _substitutes() -> list[int]:
    """The S-box as a table."""
    powers = [1]
    for _ in range(254):
        doubled = powers[-1] << 1
        powers.append(powers[-1] ^ (doubled ^ 0x11B if doubled & 0x100 else doubled))
    table = [_ADDED] * 256
    for number, power in enumerate(powers):
        inverse = powers[-number % 255] * 0x101
        table[power] = (inverse ^ inverse >> 4 ^ inverse >> 5 ^ inverse >> 6 ^ inverse >> 7) & 0xFF ^ _ADDED
    return table


_TABLE = _substitutes()


def new_key(key: bytes, record: np.void) -> None:
    """Fill a KEY record, within an array, from the 16 bytes of an AES-128 key."""
    expanded, constant = list(key), 1
    while len(expanded) < 16 * 11:
        last = expanded[-4:]
        if len(expanded) % 16 == 0:
            last = [_TABLE[byte] for byte in last[1:] + last[:1]]
            last[0] ^= constant
            constant = constant << 1 ^ (0x11B if constant & 0x80 else 0)
        expanded += [a ^ b for a, b in zip(expanded[-16:-12], last, strict=True)]
    for number in range(11):
        added = _ADDED if number else 0
        octets = [byte ^ added for byte in expanded[16 * number : 16 * number + 16]]
        record["rounds"][number] = [sum((byte >> i & 1) << n for n, byte in enumerate(octets)) for i in range(8)]
    _add_subkeys(record)
