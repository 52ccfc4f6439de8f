"""What the vendor SDK's packet handlers need of a port."""


class VendorPort:
    """What is written is kept; what is read is given."""

    is_using = False

    def __init__(self, answer: bytes = b""):
        self.written, self.answer = b"", answer

    def clearPort(self):
        self.written = b""

    def writePort(self, packet):
        self.written += bytes(packet)
        return len(packet)

    def readPort(self, length):
        data, self.answer = self.answer[:length], self.answer[length:]
        return list(data)

    def setPacketTimeout(self, length):
        self.is_using = True

    def isPacketTimeout(self):
        return not self.answer
