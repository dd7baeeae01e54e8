"""The runtime: state -> policy -> safety -> motors. No torch, ever."""

import os

# From 1.29 on onnxruntime sends its maker what it runs on, from threads that it starts in the process of the pilot, where
# nothing may take a core or the memory map away. Read once, when it is first imported (microsoft/onnxruntime#27379).
os.environ["ORT_DISABLE_TELEMETRY"] = "1"
