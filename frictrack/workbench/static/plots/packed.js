// Scenes and columns as Python packs them (plot_data.PlotData.pack).

/** Split an answer: uint32 length of the JSON scene, the scene, then its columns as Float32, little endian. */
export function parsePacked(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const scene = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  return { scene, columns: columnsOf(scene, buffer.slice(4 + length)) };
}

/** Columns of a scene by name, without a copy. */
export function columnsOf(scene, buffer) {
  const all = new Float32Array(buffer, 0, buffer.byteLength >> 2);
  const places = Object.entries(scene.columns || {});
  return Object.fromEntries(places.map(([key, [offset, count]]) => [key, all.subarray(offset, offset + count)]));
}

/** Whether two columns hold the same numbers; NaN equals NaN. */
export function sameColumn(a, b) {
  if (a === b) return true;
  if (!a || !b || a.length !== b.length) return false;
  for (let i = 0; i < a.length; i++) if (a[i] !== b[i] && (a[i] === a[i] || b[i] === b[i])) return false;
  return true;
}

/** Call `each(from, to)` for every span of finite values within [first, last). */
export function finitePieces(values, first, last, each) {
  for (let i = first; i < last;) {
    while (i < last && values[i] !== values[i]) i++;
    const from = i;
    while (i < last && values[i] === values[i]) i++;
    if (i > from) each(from, i);
  }
}
