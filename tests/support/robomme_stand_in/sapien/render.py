class RenderSystem:
    def __init__(self, device):
        assert device == "cpu"


def get_device_summary():
    device = "GPU: {}\n  Supported: {}\n  Present:   0\n  cudaId:    {}\n  rayTrace:  1\n"
    return device.format("broken GPU", 0, 0) + device.format("GPU of the stand-in", 1, -1)
