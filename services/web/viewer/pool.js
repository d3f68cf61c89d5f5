// Which groups lie in GPU memory, and in which of its slots. There are as many slots as groups, or, of a file with levels that is larger than the
// budget, fewer: then groups that are not wanted any more make room, those first that were not for longest, of equals the finest.

export class Pool {
  constructor(nGroups, nSlots) {
    Object.assign(this, { nGroups, nSlots: Math.min(nGroups, nSlots), clock: 0 });
    this.slotOf = new Int32Array(nGroups).fill(-1);
    this.groupOf = new Int32Array(this.nSlots).fill(-1);
    this.wantedAt = new Float64Array(nGroups);
  }

  get isWhole() {
    return this.nSlots === this.nGroups;
  }

  /** From here on `groups`, the most wanted first, are not to make room; returns those of them that there are slots for. */
  want(groups) {
    const kept = this.isWhole ? groups : groups.slice(0, this.nSlots - 1);
    this.clock += 1;
    for (const group of kept) this.wantedAt[group] = this.clock;
    return kept;
  }

  /** The slot of a wanted group; `evicted(group)` hears whose it was. The last group, which may be a short one, has the last slot for itself. */
  place(group, evicted) {
    if (this.slotOf[group] >= 0) return this.slotOf[group];
    const slot = this.isWhole ? group : group === this.nGroups - 1 ? this.nSlots - 1 : this.oldest();
    const before = this.groupOf[slot];
    if (before >= 0) {
      this.slotOf[before] = -1;
      evicted(before, slot);
    }
    this.groupOf[slot] = group;
    this.slotOf[group] = slot;
    return slot;
  }

  oldest() {
    let best = 0;
    const age = (slot) => (this.groupOf[slot] < 0 ? -1 : this.wantedAt[this.groupOf[slot]]);
    for (let slot = 1; slot < this.nSlots - 1; ++slot)
      if (age(slot) < age(best) || (age(slot) === age(best) && this.groupOf[slot] > this.groupOf[best])) best = slot;
    return best;
  }
}
