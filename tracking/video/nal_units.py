"""The units that packets of H.264 and HEVC are made of (Rec. ITU-T H.264, 7.3.1 and annex B; H.265 likewise)."""

from dataclasses import dataclass, field

import av

MARK = b"\0\0\1"
# In a file's record of parameters (ISO/IEC 14496-15), which begins so: where it says how many bytes a length has.
VERSION, LENGTHS = b"\1", {"h264": 4, "hevc": 21}
# Of a unit of H.264: the bits that say whether others refer to it, and of what kind it is; parts of pictures have kinds
# up to 5. The message of when pictures are right where decoding begins there (D.1.8).
USE, KIND, WHOLE, MESSAGES, RECOVERY = 0x60, 31, 5, 6, 6


@dataclass(frozen=True)
class Units:
    """How a video tells its units apart.

    Attributes:
        length: of how many bytes the length before each unit is; 0 where there are marks between them instead.
    """

    length: int

    @classmethod
    def of(cls, codec: str, parameters: bytes | None) -> "Units":
        """By what a video's beginning says."""
        record = parameters or b""
        place = LENGTHS[codec]
        return cls(1 + (record[place] & 3) if record.startswith(VERSION) and len(record) > place else 0)

    def split(self, content: bytes) -> list[bytes]:
        """A packet's units; none where their lengths do not add up."""
        if not self.length:
            return [unit.rstrip(b"\0") for unit in content.split(MARK)[1:] if len(unit) > 1]
        units, start = [], 0
        while start < len(content):
            end = start + self.length + int.from_bytes(content[start : start + self.length], "big")
            if end > len(content) or end < start + self.length + 2:
                return []
            units.append(content[start + self.length : end])
            start = end
        return units

    def parts(self, content: bytes) -> int:
        """How many parts of pictures a packet of H.264 holds."""
        return sum(0 < unit[0] & KIND <= WHOLE for unit in self.split(content))

    def joined(self, units: list[bytes]) -> bytes:
        """A packet of units."""
        return b"".join((len(unit).to_bytes(self.length, "big") if self.length else MARK) + unit for unit in units)


@dataclass
class Renewals:
    """Finds the packets of H.264 from which on pictures need nothing that came long before.

    That is key frames; and where an encoder renews its pictures column by column instead, whose first column's packet
    passes for a key frame, those that complete them.

    Attributes:
        units: how to tell them apart.
        begun: of each renewal that is not complete, how many packets ago it began, and how many pictures that others
            refer to are left to come.
    """

    units: Units
    begun: list[tuple[int, int]] = field(default_factory=list)

    def since(self, packet: "av.packet.Packet") -> int | None:
        """How many packets before this one are needed from it on; None where that begins with no other than before."""
        if not packet.is_keyframe and not self.begun:
            return None
        units = self.units.split(bytes(packet))
        refers = any(unit[0] & USE and unit[0] & KIND <= WHOLE for unit in units)
        self.begun = [(age + 1, left - refers) for age, left in self.begun]
        complete = [age for age, left in self.begun if left <= 0]
        self.begun = [(age, left) for age, left in self.begun if left > 0]
        if packet.is_keyframe:
            left = _until_right(units)
            if not left:
                self.begun = []
                return 0
            self.begun.append((0, left))
        return min(complete, default=None)


def _until_right(units: list[bytes]) -> int:
    """How many pictures that others refer to come before the first that is right where decoding begins with these."""
    for unit in units:
        if unit[0] & KIND == MESSAGES and unit[1] == RECOVERY and len(unit) > 3:
            bits = "".join(f"{byte:08b}" for byte in unit[3:11])
            zeros = len(bits) - len(bits.lstrip("0"))
            return int(bits[zeros : 2 * zeros + 1] or "1", 2) - 1
    return 0
