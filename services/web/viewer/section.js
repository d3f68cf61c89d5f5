// A box of the scan's axes that cuts away what is outside: six sliders over the extent of what a picture of the whole shows.

const STEPS = 1000, BEYOND = 1e30;

export class Section {
  /** `panel` gets the sliders; `corners` lie against the header's origin; `changed()` is called when the box is another. */
  constructor(panel, { origin, radius, unit }, corners, changed) {
    const extreme = (axis, pick) => corners.reduce((most, corner) => pick(most, corner[axis]), corners[0][axis]);
    this.low = [0, 1, 2].map((axis) => extreme(axis, Math.min));
    this.high = [0, 1, 2].map((axis) => extreme(axis, Math.max));
    const decimals = Math.min(9, Math.max(0, Math.ceil(-Math.log10(radius))));
    this.inputs = [0, 1, 2].flatMap((axis) => ["from", "to"].map((side) => {
      const name = `${"xyz"[axis]} ${side}`, output = document.createElement("output"), label = document.createElement("label");
      const input = Object.assign(document.createElement("input"), { type: "range", min: 0, max: STEPS, value: side === "to" ? STEPS : 0 });
      const say = () => { output.value = (origin[axis] + this.at(axis, input.value)).toFixed(decimals); };
      input.oninput = () => { say(); changed(); };
      input.title = `cut away what lies beyond, ${unit}`;
      label.append(name, " ", input, output);
      panel.append(label);
      say();
      return input;
    }));
  }

  at(axis, value) {
    return this.low[axis] + ((this.high[axis] - this.low[axis]) * value) / STEPS;
  }

  /** Lowest and highest corner against the origin, open to the sides where a slider is at its end; null where all are. */
  get box() {
    const values = this.inputs.map((input) => Number(input.value)), ends = values.every((value, i) => value === (i % 2 ? STEPS : 0));
    const side = (end, beyond, i) => [0, 1, 2].map((axis) => (values[2 * axis + i] === end ? beyond : this.at(axis, values[2 * axis + i])));
    return ends ? null : { low: side(0, -BEYOND, 0), high: side(STEPS, BEYOND, 1) };
  }
}
