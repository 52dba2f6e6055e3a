"""How a measurement tool reaches the XCP server, for the A2L file: IF_DATA XCP, and the A2ML that describes it."""

from typing import NamedTuple

from emb_daemon.wire.contract import CYCLE_NS
from emb_daemon.wire.layout import CORNERS
from emb_daemon.workshop.pages import FILES, WORKING
from emb_daemon.workshop.xcp import CALIBRATING, LISTS, MILLISECONDS, ON_CAN, ON_UDP, READING, Transport

#: Time in ms for which a tool waits for an answer: longer than the daemon may take to check a page (`runtime.pages`).
_T1_MS = 5000
#: Versions of the protocol layer, 1.1, and of the transport layers, 1.0.
_PROTOCOL, _LAYER = 0x0101, 0x0100
#: Commands that every slave has; the file lists the other ones.
_MANDATORY = {"CONNECT", "DISCONNECT", "GET_STATUS", "SYNCH"}
_OPTIONAL = {name: command.code for name, command in (READING | CALIBRATING).items() if name not in _MANDATORY}
_UNITS = {3: "UNIT_1US", 5: "UNIT_100US"}
_SIZES = {2: "SIZE_WORD", 4: "SIZE_DWORD"}


class Connection(NamedTuple):
    """A transport and the block with its address."""

    layer: Transport
    block: str


def over_udp(host: str, port: int) -> Connection:
    """``host`` is an IPv4 address, or a name."""
    kind = "ADDRESS" if all(part.isdecimal() for part in host.split(".")) else "HOST_NAME"
    return Connection(ON_UDP, f'/begin XCP_ON_UDP_IP 0x{_LAYER:04X} {port} {kind} "{host}" /end XCP_ON_UDP_IP')


def over_can(request_id: int, response_id: int, bitrate: int | None) -> Connection:
    """11-bit CAN ids; bit/s where it is known."""
    rate = f" BAUDRATE {bitrate}" if bitrate else ""
    ids = f"CAN_ID_MASTER 0x{request_id:X} CAN_ID_SLAVE 0x{response_id:X}"
    return Connection(ON_CAN, f"/begin XCP_ON_CAN 0x{_LAYER:04X} {ids}{rate} /end XCP_ON_CAN")


def module_block(connection: Connection, calibrate: bool) -> str:
    """IF_DATA of the module."""
    layer = connection.layer
    # The command does not exist if a packet has no room after its header.
    missing = set() if calibrate else set(CALIBRATING)
    if layer.max_cto <= 8:
        missing.add("SHORT_DOWNLOAD")
    commands = " ".join(f"OPTIONAL_CMD {name}" for name in _OPTIONAL if name not in missing)
    cycle_ms = CYCLE_NS // 1_000_000
    events = " ".join(
        f'/begin EVENT "{name}" "{name}" {number} DAQ {LISTS} {cycle_ms} {MILLISECONDS} 0 CONSISTENCY EVENT /end EVENT'
        for number, name in enumerate(CORNERS)
    )
    entry = min(layer.max_dto - 1, 0xFF)
    return f"""\
    /begin IF_DATA XCP
      /begin PROTOCOL_LAYER 0x{_PROTOCOL:04X} {_T1_MS} 0 0 0 0 0 0 {layer.max_cto} {layer.max_dto}
        BYTE_ORDER_MSB_LAST ADDRESS_GRANULARITY_BYTE {commands}
      /end PROTOCOL_LAYER
      /begin DAQ DYNAMIC {LISTS} {len(CORNERS)} 0 OPTIMISATION_TYPE_DEFAULT ADDRESS_EXTENSION_FREE
        IDENTIFICATION_FIELD_TYPE_ABSOLUTE GRANULARITY_ODT_ENTRY_SIZE_DAQ_BYTE {entry} OVERLOAD_INDICATION_EVENT
        PRESCALER_SUPPORTED
        /begin TIMESTAMP_SUPPORTED 1 {_SIZES[layer.timestamp_bytes]} {_UNITS[layer.unit]} /end TIMESTAMP_SUPPORTED
        {events}
      /end DAQ
      {"/begin PAG 1 /end PAG" if calibrate else ""}
      {connection.block}
    /end IF_DATA
"""


def memory_segment(address: int, size: int) -> str:
    """The calibration's segment with its two pages, at MOD_PAR."""
    page = "/begin PAGE {} ECU_ACCESS_DONT_CARE XCP_READ_ACCESS_DONT_CARE XCP_WRITE_ACCESS_{} /end PAGE"
    return f"""\
      /begin MEMORY_SEGMENT calibration "" DATA RAM INTERN 0x{address:X} 0x{size:X} -1 -1 -1 -1 -1
        /begin IF_DATA XCP
          /begin SEGMENT 0 2 0 0 0
            {page.format(WORKING, "DONT_CARE")}
            {page.format(FILES, "NOT_ALLOWED")}
          /end SEGMENT
        /end IF_DATA
      /end MEMORY_SEGMENT
"""


def _words(*names: str) -> str:
    return "enum { " + ", ".join(f'"{name}" = {number}' for number, name in enumerate(names)) + " }"


def _access(who: str, other: str) -> str:
    ways = "NOT_ALLOWED", f"WITHOUT_{other}_ONLY", f"WITH_{other}_ONLY", "DONT_CARE"
    return _words(*(f"{who}_ACCESS_{way}" for way in ways))


_PAGE_ACCESS = "; ".join([_access("ECU", "XCP"), _access("XCP_READ", "ECU"), _access("XCP_WRITE", "ECU")])
_COMMANDS = ", ".join(f'"{name}" = 0x{code:02X}' for name, code in _OPTIONAL.items())

#: Description of the blocks above, and of no other part of XCP.
A2ML = f"""\
    /begin A2ML
      block "IF_DATA" taggedunion if_data {{
        "XCP" taggedstruct {{
          block "PROTOCOL_LAYER" struct {{
            uint; uint; uint; uint; uint; uint; uint; uint; uchar; uint;
            {_words("BYTE_ORDER_MSB_LAST", "BYTE_ORDER_MSB_FIRST")};
            enum {{ "ADDRESS_GRANULARITY_BYTE" = 1 }};
            taggedstruct {{ ("OPTIONAL_CMD" enum {{ {_COMMANDS} }})*; }};
          }};
          block "DAQ" struct {{
            {_words("STATIC", "DYNAMIC")};
            uint; uint; uchar;
            enum {{ "OPTIMISATION_TYPE_DEFAULT" = 0 }};
            enum {{ "ADDRESS_EXTENSION_FREE" = 0 }};
            enum {{ "IDENTIFICATION_FIELD_TYPE_ABSOLUTE" = 0 }};
            enum {{ "GRANULARITY_ODT_ENTRY_SIZE_DAQ_BYTE" = 1 }};
            uchar;
            {_words("NO_OVERLOAD_INDICATION", "OVERLOAD_INDICATION_PID", "OVERLOAD_INDICATION_EVENT")};
            taggedstruct {{
              "PRESCALER_SUPPORTED";
              block "TIMESTAMP_SUPPORTED" struct {{
                uint;
                enum {{ "SIZE_WORD" = 2, "SIZE_DWORD" = 4 }};
                enum {{ "UNIT_1US" = 3, "UNIT_100US" = 5 }};
              }};
              (block "EVENT" struct {{
                char[101]; char[9]; uint;
                enum {{ "DAQ" = 1, "STIM" = 2, "DAQ_STIM" = 3 }};
                uchar; uchar; uchar; uchar;
                taggedstruct {{ "CONSISTENCY" enum {{ "DAQ" = 0, "EVENT" = 1 }}; }};
              }})*;
            }};
          }};
          block "PAG" struct {{ uchar; }};
          block "SEGMENT" struct {{
            uchar; uchar; uchar; uchar; uchar;
            taggedstruct {{
              (block "PAGE" struct {{ uchar; {_PAGE_ACCESS}; }})*;
            }};
          }};
          block "XCP_ON_UDP_IP" struct {{
            uint; uint;
            taggedunion {{ "HOST_NAME" char[256]; "ADDRESS" char[15]; }};
          }};
          block "XCP_ON_CAN" struct {{
            uint;
            taggedstruct {{ "CAN_ID_MASTER" ulong; "CAN_ID_SLAVE" ulong; "BAUDRATE" ulong; }};
          }};
        }};
      }};
    /end A2ML
"""
