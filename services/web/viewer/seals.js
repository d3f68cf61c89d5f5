// Seals of groups, checked when all of a group has arrived: SHA-256 of its zarr chunks as they stand in the file (docs/FORMAT.md, `group_seal`).

export class Seals {
  /** `seals` (nGroups, 32) bytes; `arrays` are what a group consists of, in the order of the file. */
  constructor(seals, arrays) {
    Object.assign(this, { seals, arrays, parts: new Map(), checked: 0 });
    this.digest = globalThis.crypto?.subtle; // not on pages that came over a network without encryption
  }

  /** The chunk of an array of a group. Ends with an error where it was the last one and the group is not what was sealed. */
  async hear(array, group, bytes) {
    if (!this.digest) return;
    const parts = { ...this.parts.get(group), [array]: bytes };
    this.parts.set(group, parts);
    if (!this.arrays.every((name) => parts[name])) return;
    this.parts.delete(group);
    const found = new Uint8Array(await this.digest.digest("SHA-256", await new Blob(this.arrays.map((name) => parts[name])).arrayBuffer()));
    if (!found.every((byte, i) => byte === this.seals[32 * group + i])) throw new Error(`group ${group} is damaged: it is not what its seal says`);
    this.checked += 1;
  }

  forget(group) {
    this.parts.delete(group);
  }
}
