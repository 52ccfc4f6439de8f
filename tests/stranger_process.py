"""A process that is not our child, such as one whose parent was killed."""


def ends(pid):
    """Whether a process that is not our child is gone, or soon will be: it has nothing left to wait for."""
    for _ in range(10_000_000):
        try:
            with open(f"/proc/{pid}/stat") as stat:
                if stat.read().rpartition(")")[2].split()[0] == "Z":
                    return True
        except FileNotFoundError:
            return True
    return False
