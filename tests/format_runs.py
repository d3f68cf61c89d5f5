"""The codes of a group's runs, decoded as docs/FORMAT.md says and by nothing else: slow, in Python's whole numbers."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class Coder:
    """The range coder's reader. Models are 2,048 until they are first asked for."""

    data: bytes
    at: int = 4
    code: int = 0
    range: int = 2**32 - 1
    models: dict[tuple, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.code = int.from_bytes(self.data[:4].ljust(4, b"\0"), "big")

    def _filled(self) -> None:
        while self.range < 2**24:
            self.range *= 256
            self.code = self.code * 256 + (self.data[self.at] if self.at < len(self.data) else 0)
            self.at += 1

    def bit(self, *model) -> int:
        p = self.models.get(model, 2048)
        bound = self.range // 4096 * p
        is_one = self.code >= bound
        self.models[model] = p - p // 16 if is_one else p + (4096 - p) // 16
        self.code, self.range = (self.code - bound, self.range - bound) if is_one else (self.code, bound)
        self._filled()
        return int(is_one)

    def even(self, bits: int) -> int:
        value = 0
        for _ in range(bits):
            self.range //= 2
            is_one = self.code >= self.range
            self.code -= self.range * is_one
            value = 2 * value + is_one
            self._filled()
        return value

    def tree(self, bits: int, *context) -> int:
        node = 1
        for _ in range(bits):
            node = 2 * node + self.bit(*context, node)
        return node - 2**bits

    def signed(self, *context) -> int:
        n = self.tree(4, *context, "bits")
        if not n:
            return 0
        negative, size = self.bit(*context, "sign", n), 1
        if n > 1:
            size = 2 * size + self.bit(*context, "second", n)
        if n > 2:
            size = 2 * size + self.bit(*context, "third", n, size % 2)
        if n > 3:
            size = (size << n - 3) + self.even(n - 3)
        return -size if negative else size


@dataclass(frozen=True)
class Run:
    column: int
    row: int
    slice_: int
    normal: tuple[int, int]
    steps: list[tuple[int, int]]  # turn, entry of the codebook


def runs_of_group(data: bytes, n_cells: int) -> list[Run]:
    """All runs of a group of so many splats."""
    coder, runs, cells = Coder(data), [], 0
    base, column, row, slice_ = [0, 0, 0], 0, 0, 0
    while cells < n_cells:
        for axis in range(3):
            if coder.bit("base", axis):
                base[axis] = coder.even(22) - 2**20
        for _ in range(coder.even(8) + 1):
            length, change = coder.tree(5, "length") + 1, coder.tree(5, "slice")
            slice_ = (slice_ + change) % 32
            of_row = coder.signed("row", change == 0)
            row = (row + of_row) % 2048
            column = (column + coder.signed("column", 1 + min(2, abs(of_row)) if change == 0 else 0)) % 2048
            a = coder.tree(8, "a")
            b = coder.tree(8, "b", a // 32)
            steps, turns, before = [], (0, 0), 0
            for _ in range(length - 1):
                turn = coder.tree(3, "turn", turns)
                before = coder.tree(5, "step", before)
                steps.append((turn, before))
                turns = turns[1], turn
            normal = a - 256 * (a > 127), b - 256 * (b > 127)
            runs.append(Run(base[0] + column, base[1] + row, base[2] + slice_, normal, steps))
            cells += length
    assert cells == n_cells and coder.at == len(data)
    return runs
