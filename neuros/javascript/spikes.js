// Spikes of one output, as long as a panel shows them.

export class SpikeTrain {
  constructor(keptS) {
    this.keptS = keptS;
    this.forget();
  }

  forget() {
    this.batches = [];
    this.size = 0;
    this.beginS = this.endS = null; // what is outside is not known
    this.missing = 0; // that passed, but were not sent here
  }

  // A sample of a node: base64 of uint32 senders and of float64 times in seconds.
  add({senders, times, size, count, stamp_s: stampS}) {
    this.put(new Uint32Array(buffer(senders)), new Float64Array(buffer(times)), size, stampS);
    this.missing = count - this.batches.at(-1).times.length;
  }

  put(senders, times, size, stampS = 0) {
    let [firstS, lastS] = [Infinity, stampS];
    for (const timeS of times) {
      firstS = Math.min(firstS, timeS);
      lastS = Math.max(lastS, timeS);
    }
    // A simulation that was reset begins again.
    if (this.endS !== null && lastS < this.endS) this.forget();
    this.size = Math.max(this.size, size, senders.reduce((most, each) => Math.max(most, each + 1), 0));
    this.endS = Math.max(this.endS ?? lastS, lastS);
    this.beginS ??= Math.min(firstS, lastS);
    this.batches.push({senders, times, lastS});
    this.batches = this.batches.filter((each) => each.lastS >= this.endS - this.keptS);
  }

  // Calls `take(sender, time in seconds)` for every spike from one time on up to another.
  each(beginS, endS, take) {
    for (const {senders, times} of this.batches) {
      for (let place = 0; place < times.length; place++) {
        if (times[place] >= beginS && times[place] <= endS) take(senders[place], times[place]);
      }
    }
  }
}

// The bin that a time is in. Simulators place spikes on a grid: one on the edge of a bin is in the
// later one, also where the division is a little too small.
export function binOf(timeS, binS) { return Math.floor(timeS / binS + 1e-6); }

export function buffer(text) {
  return Uint8Array.from(atob(text), (character) => character.charCodeAt(0)).buffer;
}
