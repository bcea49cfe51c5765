class RenderSystem:
    def __init__(self, device):
        assert device == "cpu"
