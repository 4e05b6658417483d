"""An independent client (`ur_rtde`) with the simulated controller, in a separate process, since its
constructors keep the interpreter's lock. Prints its data as JSON."""

import json
import sys
import time

import dashboard_client
import rtde_receive

HOST = sys.argv[1]
FIELDS = ["timestamp", "actual_q", "robot_mode", "safety_mode", "runtime_state"]
dashboard = dashboard_client.DashboardClient(HOST)
dashboard.connect()
END = time.monotonic() + 60.0  # less than the test waits
dashboard.powerOn()
while "IDLE" not in dashboard.robotmode() and time.monotonic() < END:
    time.sleep(0.05)
dashboard.brakeRelease()
receive = rtde_receive.RTDEReceiveInterface(HOST, -1.0, FIELDS)
while receive.getRobotMode() != 7 and time.monotonic() < END:
    time.sleep(0.05)
first = receive.getTimestamp()
while receive.getTimestamp() - first <= 0.1 and time.monotonic() < END:
    time.sleep(0.05)
seen = {
    "q": receive.getActualQ(),
    "mode": receive.getRobotMode(),
    "safety": receive.getSafetyMode(),
    "time": receive.getTimestamp() - first,
    "robotmode": dashboard.robotmode(),
    "running": dashboard.running(),
}
receive.disconnect()
dashboard.disconnect()
print(json.dumps(seen), flush=True)
