"""Reads and writes unit 32 through the bridge with pymodbus, RTU frames over TCP: poll_station.py PORT"""

import sys

from pymodbus import FramerType
from pymodbus.client import ModbusTcpClient

client = ModbusTcpClient("127.0.0.1", port=int(sys.argv[1]), framer=FramerType.RTU, timeout=60, retries=0)
assert client.connect()

read = client.read_input_registers(0x0040, count=8, device_id=32)
assert not read.isError(), read
print("AI", *read.registers)

write = client.write_registers(0x0060, [11, 22, 33], device_id=32)
assert not write.isError(), write
back = client.read_holding_registers(0x0060, count=3, device_id=32)
assert back.registers == [11, 22, 33], back.registers

write = client.write_coils(0x0200, [True, False, True, True], device_id=32)
assert not write.isError(), write
assert client.read_coils(0x0200, count=4, device_id=32).bits[:4] == [True, False, True, True]

refused = client.read_input_registers(0x0050, count=1, device_id=32)
assert refused.isError() and refused.exception_code == 2, refused

client.close()
print("pymodbus: all as expected")
