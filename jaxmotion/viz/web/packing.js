// Unpacks the page's files: gzip by the browser, LZMA here. Programs and graphs are a
// third smaller as LZMA, weights are not; `export/web.py` writes what is worth it.
// Source: Igor Pavlov's LZMA specification (public domain), 2015.

const HALF = 1024, TOP = 2 ** 24, STATES = 12, HEAD = 13;

const probabilities = count => new Uint16Array(count).fill(HALF);
// Lengths: two choices, then trees of 8 (by place), 8 (by place) and 256.
const lengths = () => probabilities(2 + 2 * 128 + 256);

// A file's content, packed or not; damaged files throw.
export async function unpacked(bytes) {
  if (bytes[0] === 0x5d && bytes[1] === 0) return unlzma(bytes);
  if (bytes[0] !== 0x1f || bytes[1] !== 0x8b) return bytes;
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

const damaged = () => { throw new Error("damaged"); };

// Of Python's `lzma.FORMAT_ALONE`, which ends with a marker; with the size in its head.
function unlzma(bytes) {
  if (bytes.length < HEAD + 5) damaged();
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const size = Number(view.getBigUint64(5, true));
  const lc = bytes[0] % 9, lp = Math.floor(bytes[0] / 9) % 5, pb = Math.floor(bytes[0] / 45);
  if (!(size < 2 ** 30) || pb > 4) damaged();
  const out = new Uint8Array(size), placeMask = (1 << pb) - 1, literalMask = (1 << lp) - 1;
  let at = HEAD + 5, range = -1 >>> 0, code = view.getUint32(HEAD + 1);

  // A bit whose likelihood is number i of a table, which learns.
  function bit(table, i) {
    const p = table[i], bound = (range >>> 11) * p;
    let found = 0;
    if (code < bound) {
      range = bound;
      table[i] = p + ((2048 - p) >> 5);
    } else {
      range -= bound;
      code -= bound;
      table[i] = p - (p >> 5);
      found = 1;
    }
    if (range < TOP) {
      range = (range << 8) >>> 0;
      code = ((code << 8) | bytes[at++]) >>> 0;
    }
    return found;
  }
  function tree(table, start, bits) {
    let node = 1;
    for (let i = 0; i < bits; i++) node = 2 * node + bit(table, start + node);
    return node - (1 << bits);
  }
  function reversed(table, start, bits) {
    let node = 1, found = 0;
    for (let i = 0; i < bits; i++) {
      const one = bit(table, start + node);
      node = 2 * node + one;
      found |= one << i;
    }
    return found;
  }
  function direct(bits) {
    let found = 0;
    for (let i = 0; i < bits; i++) {
      range >>>= 1;
      const one = code >= range ? 1 : 0;
      if (one) code -= range;
      found = 2 * found + one;
      if (range < TOP) {
        range = (range << 8) >>> 0;
        code = ((code << 8) | bytes[at++]) >>> 0;
      }
    }
    return found;
  }
  function length(table, place) {
    if (!bit(table, 0)) return 2 + tree(table, 2 + 8 * place, 3);
    if (!bit(table, 1)) return 10 + tree(table, 130 + 8 * place, 3);
    return 18 + tree(table, 258, 8);
  }

  const literals = probabilities(0x300 << (lc + lp)), slots = probabilities(4 * 64);
  const isMatch = probabilities(STATES << 4), isLong = probabilities(STATES << 4);
  const [isRep, isRep0, isRep1, isRep2] = [0, 1, 2, 3].map(() => probabilities(STATES));
  const [matchLengths, repLengths] = [lengths(), lengths()];
  const near = probabilities(128), aligned = probabilities(16);
  let state = 0, rep0 = 0, rep1 = 0, rep2 = 0, rep3 = 0, n = 0;
  for (;;) {
    if (at > bytes.length) damaged();
    const place = n & placeMask;
    if (!bit(isMatch, (state << 4) + place)) {
      if (n === size) damaged();
      const before = n ? out[n - 1] : 0;
      const start = 0x300 * (((n & literalMask) << lc) + (before >> (8 - lc)));
      let symbol = 1;
      if (state >= 7) {
        let other = out[n - rep0 - 1];
        do {
          const guess = (other >> 7) & 1, one = bit(literals, start + ((1 + guess) << 8) + symbol);
          other <<= 1;
          symbol = 2 * symbol + one;
          if (guess !== one) break;
        } while (symbol < 0x100);
      }
      while (symbol < 0x100) symbol = 2 * symbol + bit(literals, start + symbol);
      out[n++] = symbol;
      state = state < 4 ? 0 : state < 10 ? state - 3 : state - 6;
      continue;
    }
    let count;
    if (!bit(isRep, state)) {
      [rep3, rep2, rep1] = [rep2, rep1, rep0];
      count = length(matchLengths, place);
      state = state < 7 ? 7 : 10;
      const slot = tree(slots, 64 * Math.min(count - 2, 3), 6), bits = (slot >> 1) - 1;
      if (slot < 4) rep0 = slot;
      else if (slot < 14) {
        rep0 = (2 | (slot & 1)) << bits;
        rep0 += reversed(near, rep0 - slot, bits);
      } else rep0 = (2 | (slot & 1)) * 2 ** bits + 16 * direct(bits - 4) + reversed(aligned, 0, 4);
      if (rep0 === 2 ** 32 - 1) break;
    } else {
      if (!bit(isRep0, state)) {
        if (!bit(isLong, (state << 4) + place)) {
          if (rep0 >= n || n === size) damaged();
          state = state < 7 ? 9 : 11;
          out[n] = out[n - rep0 - 1];
          n++;
          continue;
        }
      } else if (!bit(isRep1, state)) [rep0, rep1] = [rep1, rep0];
      else if (!bit(isRep2, state)) [rep0, rep1, rep2] = [rep2, rep0, rep1];
      else [rep0, rep1, rep2, rep3] = [rep3, rep0, rep1, rep2];
      count = length(repLengths, place);
      state = state < 7 ? 8 : 11;
    }
    if (rep0 >= n || n + count > size) damaged();
    for (let i = 0; i < count; i++, n++) out[n] = out[n - rep0 - 1];
  }
  if (n !== size || code !== 0) damaged();
  return out;
}
