"""An NST sensor on the bridge's CAN port, made with python-can over SLCAN: answer_sensor.py PORT BYTE..."""

import sys

import can

port, sample = int(sys.argv[1]), bytes(int(value) for value in sys.argv[2:])
bus = can.Bus(interface="slcan", channel=f"socket://127.0.0.1:{port}", bitrate=1_000_000)
print("listening", flush=True)

request = bus.recv(timeout=60)
assert request is not None, "no request came"
assert request.is_extended_id and request.arbitration_id == 0x007F0110, request
assert bytes(request.data) == bytes([0x03, 0x02, 0x00, 0x12]), request

reply = bytes([0x03, len(sample)]) + sample
for identifier, start in ((0x00017F20, 0), (0x00017F41, 8), (0x00017F82, 16)):
    data = reply[start : start + 8]
    bus.send(can.Message(arbitration_id=identifier, is_extended_id=True, data=data))
# the port confirms what has been on the bus; stay until then
bus.recv(timeout=1)
bus.shutdown()
print("python-can: answered")
