"""A DBC file written by hand, with a sensor and a servo that it describes."""

import math

FILE = """VERSION ""

NS_ :

BS_:

BU_: Host Node

BO_ 256 Motion: 8 Node
 SG_ Page M : 0|8@1+ (1,0) [0|0] "" Host
 SG_ Angle m0 : 8|32@1- (0.01,0) [0|0] "deg" Host
 SG_ Speed m1 : 8|16@1- (0.1,0) [0|0] "rpm" Host

BO_ 257 Status: 2 Node
 SG_ Mode : 0|4@1+ (1,0) [0|0] "" Host
 SG_ Fault : 8|8@1+ (1,0) [0|0] "" Host

BO_ 258 Angle: 4 Node
 SG_ Angle : 7|32@0- (0.01,0) [0|0] "deg" Host

BO_ 259 Load: 4 Node
 SG_ Force : 0|16@1- (0.5,-10) [0|0] "" Host
 SG_ Heat : 16|8@1+ (1,-40) [0|0] "degC" Host

BO_ 512 Go: 6 Host
 SG_ Mode : 0|8@1+ (1,0) [0|0] "" Node
 SG_ Angle : 15|32@0- (0.01,0) [-9000|9000] "deg" Node

BO_ 513 Push: 2 Host
 SG_ Torque : 0|16@1- (0.25,-20) [-8000|8000] "" Node

VAL_ 257 Mode 0 "OFF" 1 "ON" 2 "BUSY" ;
VAL_ 512 Mode 0 "OFF" 1 "ON" ;
"""
DEGREE = math.pi / 180.0
SENSOR = {
    "node_offset": 4,
    "periods": {"Motion": 0.005, "Status": 0.1},
    "quantities": {
        "position": {"signal": "Motion.Angle", "scale": DEGREE},
        "velocity": {"signal": "Motion.Speed", "scale": 6 * DEGREE},
    },
    "error": {"signal": "Status.Fault", "good": 0},
}
SERVO = {
    "node_offset": 4,
    "periods": {"Angle": "cycle", "Status": 0.05},
    "quantities": {"position": {"signal": "Angle.Angle", "scale": DEGREE}},
    "command": {"quantity": "position", "send": "Go", "signal": "Angle", "values": {"Mode": "ON"}},
    "state": {"signal": "Status.Mode", "ready": ["OFF"], "enabled": ["ON"]},
    "enable": [{"send": "Go", "values": {"Mode": "ON"}, "until": {"signal": "Status.Mode", "equals": "ON"}}],
    "disable": [{"send": "Go", "values": {"Mode": "OFF"}, "until": {"signal": "Status.Mode", "equals": "OFF"}}],
    "allow_no_watchdog": True,
}


def settings(kind, given, **changes):
    return kind.model_validate({"dbc": "node.dbc", **given, **changes})
