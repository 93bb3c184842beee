"""Keys and values of a transformer's last tokens, in a ring for each layer."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from torchrl_nerd.modules.history import History, replaced, stored


@dataclass
class KeyValueCache(History):
    """Keys and values of the last ``band`` tokens of every layer.

    ``last`` is what the last token adds to the embedding of the next one, of width zero
    without ``pairs``.
    """

    keys: list[Tensor]  # per layer (rows, heads, band, head width)
    values: list[Tensor]  # the same
    age: Tensor  # (rows,): tokens seen since the env's reset, at most band - 1
    # (1,): where the oldest token lies, which the next one overwrites; a tensor, so that
    # compiled code is the same for all of them
    slot: Tensor
    last: Tensor  # (rows, *hidden)

    def clear(self, rows: Tensor) -> None:
        """See `History.clear`."""
        # the rings stay as they are: nobody sees what is older than the age, and emptying
        # them at every reset of some env took longer than a step of all
        self.age = stored(self.age, self.age.masked_fill(rows, 0))
        slot = self.slot.masked_fill(rows.all(), 0)  # as in a new one
        self.slot = stored(self.slot, slot)
        self.last = replaced(self.last, rows, 0.0)

    def restore(self, past: "KeyValueCache", rows: Tensor) -> None:
        """See `History.restore`: its rings turned to where the oldest token lies now."""
        size = self.keys[0].shape[2]
        slots = torch.arange(size, device=rows.device)
        turned = (slots + past.slot - self.slot) % size
        for ring, then in ((self.keys, past.keys), (self.values, past.values)):
            for layer, old in enumerate(then):
                ring[layer] = replaced(ring[layer], rows, old.index_select(2, turned))
        self.age = stored(self.age, torch.where(rows, past.age, self.age))
        self.last = replaced(self.last, rows, past.last)

    def tensors(self) -> list[Tensor]:
        """See `History.tensors`."""
        return [*self.keys, *self.values, self.age, self.last]

    def chunk(self, parts: int) -> list["KeyValueCache"]:
        """See `History.chunk`: each has a slot of its own, which its step moves on."""
        rows = [x.chunk(parts) for x in self.tensors()]
        count, found = len(self.keys), []
        for part in zip(*rows, strict=True):
            *rings, age, last = part
            keys, values = rings[:count], rings[count:]
            found.append(KeyValueCache(keys, values, age, self.slot.clone(), last))
        return found

    def join(self, parts: list["KeyValueCache"]) -> None:
        """See `History.join`: the slot is the same in all of them."""
        self.slot.copy_(parts[0].slot)

    def __copy__(self) -> "KeyValueCache":
        """See `History.__copy__`."""
        keys, values = ([x.clone() for x in ring] for ring in (self.keys, self.values))
        rest = (x.clone() for x in (self.age, self.slot, self.last))
        return KeyValueCache(keys, values, *rest)

    def write(self, layer: int, key: Tensor, value: Tensor) -> Tensor:
        """Store one token ``(rows, heads, head width)``; with gradients, out of place.

        What is not finite is stored as zero: times a weight of zero it would be NaN, also
        in the env's next episode. The token's own output is not finite either way.
        Returns how long ago the token of every slot was, ``(band,)``.
        """
        size, device = self.keys[layer].shape[2], key.device
        slots = torch.arange(size, device=device)
        for past, x in ((self.keys, key), (self.values, value)):
            new = torch.where(x.isfinite(), x, 0.0)
            if torch.is_grad_enabled():
                later = (slots[1:] + self.slot) % size
                kept = past[layer].index_select(2, later)
                past[layer] = torch.cat((kept, new[:, :, None]), 2)
            else:
                past[layer].index_copy_(2, self.slot, new[:, :, None])
        newest = size - 1 if torch.is_grad_enabled() else self.slot
        return (newest - slots) % size

    def fill(self, layer: int, key: Tensor, value: Tensor) -> None:
        """Store the first tokens of all envs at once, ``(rows, heads, T, head width)``.

        The band keeps the last of them, and the ring ends with the very last one.
        """
        size = self.keys[layer].shape[2]
        for past, x in ((self.keys, key), (self.values, value)):
            last = torch.where(x.isfinite(), x, 0.0)[:, :, -size:]
            new = F.pad(last, (0, 0, size - last.shape[2], 0))
            past[layer] = stored(past[layer], new)

    def begin(self, count: int) -> None:
        """Count the first tokens, which `fill` stored in every layer."""
        self.slot.zero_()
        self.age.fill_(min(count, self.keys[0].shape[2] - 1))

    def advance(self) -> None:
        """Count one token."""
        size = self.keys[0].shape[2]
        # with gradients `write` shifts
        slot = self.slot * 0 if torch.is_grad_enabled() else (self.slot + 1) % size
        self.slot = stored(self.slot, slot)
        self.age = stored(self.age, (self.age + 1).clamp_max(size - 1))
