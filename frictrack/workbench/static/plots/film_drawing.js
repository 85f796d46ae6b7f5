// Draw the picture of a frame, tracked targets, drawn shapes and the cross of the keyboard.

const MAX_TRAIL = 3000; // marks of selected frames on the picture
const CORNER = 3.5; // px

/** Where the film is on its canvas: scale and corner in CSS pixels; `zoom` is {k, x, y} with the centre in px of the film. */
export function placement(film, size, zoom) {
  const k = Math.min(size.width / film.width, size.height / film.height) * zoom.k;
  const centre = zoom.k > 1 ? zoom : { x: film.width / 2, y: film.height / 2 };
  return { k, left: size.width / 2 - centre.x * k, top: size.height / 2 - centre.y * k };
}

function box(pen, [x, y, w, h]) { pen.rect(x, y, w, h); }

function cross(pen, [x, y], arm) {
  pen.moveTo(x - arm, y); pen.lineTo(x + arm, y);
  pen.moveTo(x, y - arm); pen.lineTo(x, y + arm);
}

/** Outline of a shape: [x, y], [x, y, w, h], or corners [[x, y], ...]; a ruler has two ends. */
function outline(pen, tool, shape, k, open) {
  pen.beginPath();
  if (Array.isArray(shape[0])) {
    shape.forEach(([x, y], i) => (i ? pen.lineTo(x, y) : pen.moveTo(x, y)));
    if (tool !== "ruler" && !open) pen.closePath();
    if (tool === "ruler" || open) for (const [x, y] of shape) pen.rect(x - CORNER / k, y - CORNER / k, (2 * CORNER) / k, (2 * CORNER) / k);
  } else if (shape.length === 4) box(pen, shape);
  else cross(pen, shape, 8 / k);
}

/** A dark line below the coloured one, so that it is seen on any picture. */
function stroke(pen, colour, k, width = 2) {
  pen.strokeStyle = "rgb(0 0 0 / 60%)";
  pen.lineWidth = (width + 2) / k;
  pen.stroke();
  pen.strokeStyle = colour;
  pen.lineWidth = width / k;
  pen.stroke();
}

const TOKENS = { target: "target", polygon: "target", reference: "reference", ruler: "ruler", exclude: "warn", obstacles: "warn", repair: "repair" };

const AREAS = ["exclude", "obstacles"]; // lists of shapes, filled

/** Shapes as a list of [tool, shape]; what is not drawn on the film, such as "auto", is left out. */
export function shapeList(shapes) {
  const isShape = (shape) => Array.isArray(shape) && shape.length > 1;
  const pairs = Object.entries(shapes || {}).flatMap(([tool, shape]) => {
    const all = AREAS.includes(tool) ? shape || [] : [shape];
    return all.map((one) => [tool, one]);
  });
  return pairs.filter(([, shape]) => isShape(shape));
}

/** A shape of the study file is dashed, one that is being drawn is not. */
export function drawShape(pen, colours, k, tool, shape, { open = false, dashed = false } = {}) {
  outline(pen, tool, shape, k, open);
  pen.setLineDash(dashed ? [6 / k, 4 / k] : []);
  stroke(pen, colours[TOKENS[tool] || "target"], k);
  pen.setLineDash([]);
  if (!AREAS.includes(tool)) return;
  pen.fillStyle = colours.warn;
  pen.globalAlpha = 0.25;
  pen.fill();
  pen.globalAlpha = 1;
}

/** Boxes of the tracked targets in this frame, where they are in the selected frames, and their paths if asked. */
export function drawTracks(pen, view, run, number, colours, k, path = false) {
  const row = run.first - (run.frame || 0); // of frame 0
  for (const track of run.tracks || []) {
    const xs = view.column(track.x), ys = view.column(track.y), every = Math.ceil(view.count / MAX_TRAIL);
    if (path) {
      pen.beginPath();
      for (let i = 0; i < xs.length; i++) if (Number.isFinite(xs[i])) pen.lineTo(xs[i], ys[i]);
      stroke(pen, colours.ofRun(run.index), k, 1.5);
    }
    pen.fillStyle = colours.select;
    for (let i = 0; i < view.count; i += every) {
      const n = view.chosen[i] - row;
      if (view.chosen[i] >= run.first && view.chosen[i] < run.first + run.count) pen.fillRect(xs[n] - 1.5 / k, ys[n] - 1.5 / k, 3 / k, 3 / k);
    }
    const x = xs[number], y = ys[number];
    if (!Number.isFinite(x)) continue;
    pen.beginPath();
    box(pen, [x - track.w / 2, y - track.h / 2, track.w, track.h]);
    cross(pen, [x, y], 5 / k);
    stroke(pen, colours[track.name === "reference" ? "reference" : "target"], k, 1.5);
  }
}

export function drawCross(pen, place, colours, k) {
  pen.beginPath();
  cross(pen, place, 12 / k);
  stroke(pen, colours.select, k);
}
