// Where a packed file's bytes come from: a server that answers ranges, or a page that holds them all.

const TRIES = 4;
const PAUSE_MS = 300;

/** A file on a server. Every answer must be of the file that the first one was of (ETag). Cut connections go on where they ended. */
export class HttpSource {
  constructor(url, token = "") {
    this.url = url;
    this.headers = token ? { Authorization: "Bearer " + token } : {};
    this.etag = null;
    this.size = 0;
    this.requests = this.received = 0;
    this.end = new Uint8Array(); // the last bytes, which are not asked for twice
  }

  /** The last `n` bytes, or all where there are fewer; from here on `size` is known. */
  async tail(n) {
    return this.patiently(async () => {
      const answer = await this.ask(`bytes=-${n}`);
      const range = /^bytes (\d+)-(\d+)\/(\d+)$/.exec(answer.headers.get("Content-Range") || "");
      if (answer.status === 206 && !range) throw new Error("the server names no range of what it sends");
      const bytes = new Uint8Array(await answer.arrayBuffer());
      this.received += bytes.length;
      this.etag = answer.headers.get("ETag");
      this.size = range ? Number(range[3]) : bytes.length;
      return (this.end = bytes.subarray(Math.max(0, bytes.length - n)));
    });
  }

  /** The bytes start..stop; `onBytes(offset, bytes)` hears them as they arrive, `offset` counted from the file's beginning. What is
   * asked for `again` browsers may keep; else they do not, as they answer one request about what they keep after the other. */
  async stream(start, stop, onBytes, signal, again = false) {
    let at = start;
    const known = Math.max(start, this.size - this.end.length), last = stop;
    stop = Math.min(stop, known);
    const heard = (offset, bytes) => {
      try {
        onBytes(offset, bytes);
      } catch (error) {
        throw error instanceof TypeError ? new Error(`the file cannot be read: ${error.message}`) : error; // no lost connection
      }
    };
    const goOn = async (arrived) => {
      const answer = await this.ask(`bytes=${at}-${stop - 1}`, signal, again);
      if (answer.status !== 206) throw new Error("the server answers no ranges");
      if (this.etag && answer.headers.get("ETag") !== this.etag) throw new Error("the file has changed on the server; load the page again");
      const reader = answer.body.getReader();
      for (let part; !(part = await reader.read()).done;) {
        heard(at, part.value);
        at += part.value.length;
        this.received += part.value.length;
        arrived();
      }
      if (at < stop) throw new TypeError("cut off");
    };
    if (at < stop) await this.patiently(goOn);
    if (known < last) onBytes(known, this.end.slice(known - this.size + this.end.length, last - this.size + this.end.length));
  }

  /** The file of a dictionary that ships with the program, which browsers keep: its name says what it holds. */
  async dictionary(name) {
    return this.patiently(async () => {
      const answer = await fetch(`/web/viewer/${name.slice(0, 16)}.atoms`);
      if (!answer.ok) throw new Error(`the file has atoms of the dictionary ${name.slice(0, 16)}, which this viewer does not have`);
      const bytes = new Uint8Array(await answer.arrayBuffer());
      this.received += bytes.length;
      return bytes;
    });
  }

  // Again where the connection is lost, TRIES times since something last arrived.
  async patiently(what) {
    for (let tries = 0; ;) {
      try {
        return await what(() => { tries = 0; });
      } catch (error) {
        if (!(error instanceof TypeError) || ++tries === TRIES) throw error instanceof TypeError ? new Error("no answer from the server") : error; // fetch's word for a lost connection
        await new Promise((done) => setTimeout(done, PAUSE_MS * tries));
      }
    }
  }

  async ask(range, signal, again = false) {
    this.requests += 1;
    const answer = await fetch(this.url, { headers: { ...this.headers, Range: range }, signal, cache: again ? "default" : "no-store" });
    if (answer.ok) return answer;
    const problem = await answer.json().catch(() => ({}));
    throw new Error(problem.detail || `the server answers ${answer.status} ${answer.statusText}`);
  }
}

/** A file that is here already. */
export class BytesSource {
  constructor(bytes, atoms) {
    this.bytes = bytes;
    this.atoms = atoms;
    this.size = bytes.length;
    this.requests = 0;
    this.received = bytes.length;
  }

  async tail(n) {
    return this.bytes.subarray(Math.max(0, this.size - n));
  }

  async dictionary() {
    return this.atoms;
  }

  async stream(start, stop, onBytes) {
    onBytes(start, this.bytes.subarray(start, stop));
  }
}
