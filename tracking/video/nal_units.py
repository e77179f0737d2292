"""NAL units, of which packets of H.264 consist (Rec. ITU-T H.264, 7.3.1 and annex B)."""

from dataclasses import dataclass, field

import av

START_CODE = b"\0\0\1"
# The decoder configuration record of a file (ISO/IEC 14496-15) begins with this version. The offset is that of the byte
# that holds the size of the length fields.
CONFIGURATION_VERSION, LENGTH_SIZE_OFFSET = b"\1", 4
# First byte of an H.264 unit: nal_ref_idc says whether other frames refer to it, nal_unit_type what it contains.
REF_IDC_MASK, TYPE_MASK = 0x60, 31
MAX_SLICE_TYPE, SEI_TYPE = 5, 6  # types 1 to 5 are slices
RECOVERY_POINT = 6  # SEI payload type (D.1.8): when images are correct if decoding begins here


@dataclass(frozen=True)
class NalUnits:
    """How a stream delimits its units.

    Attributes:
        length_size: bytes of the length field before each unit; 0 if start codes separate the units.
    """

    length_size: int

    @classmethod
    def of(cls, extradata: bytes | None) -> "NalUnits":
        """Read from a stream's extradata."""
        record = extradata or b""
        has_lengths = record.startswith(CONFIGURATION_VERSION) and len(record) > LENGTH_SIZE_OFFSET
        return cls(1 + (record[LENGTH_SIZE_OFFSET] & 3) if has_lengths else 0)

    def split(self, content: bytes) -> list[bytes]:
        """Units of a packet; none if their lengths do not add up."""
        if not self.length_size:
            return [unit.rstrip(b"\0") for unit in content.split(START_CODE)[1:] if len(unit) > 1]
        units, start = [], 0
        while start < len(content):
            end = start + self.length_size + int.from_bytes(content[start : start + self.length_size], "big")
            if end > len(content) or end < start + self.length_size + 2:
                return []
            units.append(content[start + self.length_size : end])
            start = end
        return units


@dataclass
class RandomAccessPoints:
    """Finds the packets of H.264 from which on frames need nothing that came long before.

    These are key frames. An encoder with periodic intra refresh renews the image column by column instead, and the
    packet with the first column is marked as a key frame. The access point is then the packet that completes a refresh.

    Attributes:
        units: splits packets.
        open_refreshes: for each incomplete refresh, the number of packets since it began and the number of reference
            frames still to come.
    """

    units: NalUnits
    open_refreshes: list[tuple[int, int]] = field(default_factory=list)

    def refresh_packets(self, packet: "av.packet.Packet") -> int | None:
        """Number of packets before this one that are needed from it on; None if it is no access point."""
        if not packet.is_keyframe and not self.open_refreshes:
            return None
        units = self.units.split(bytes(packet))
        is_reference = any(unit[0] & REF_IDC_MASK and unit[0] & TYPE_MASK <= MAX_SLICE_TYPE for unit in units)
        self.open_refreshes = [(age + 1, left - is_reference) for age, left in self.open_refreshes]
        complete = [age for age, left in self.open_refreshes if left <= 0]
        self.open_refreshes = [(age, left) for age, left in self.open_refreshes if left > 0]
        if packet.is_keyframe:
            left = _recovery_frame_count(units)
            if not left:
                self.open_refreshes = []
                return 0
            self.open_refreshes.append((0, left))
        return min(complete, default=None)


def _recovery_frame_count(units: list[bytes]) -> int:
    """Number of reference frames (recovery_frame_cnt) until images are correct if decoding begins with these units."""
    for unit in units:
        if unit[0] & TYPE_MASK == SEI_TYPE and unit[1] == RECOVERY_POINT and len(unit) > 3:
            bits = "".join(f"{byte:08b}" for byte in unit[3:11])
            zeros = len(bits) - len(bits.lstrip("0"))  # Exp-Golomb code
            return int(bits[zeros : 2 * zeros + 1] or "1", 2) - 1
    return 0
