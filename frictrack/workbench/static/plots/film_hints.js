/** What to do with each tool of the film, and with none. */
export const HINTS = {
  "": "Space plays the film; Ctrl and the wheel zoom it.",
  target: "Drag a box around the moving target; a click marks its middle.",
  polygon: "Click the corners of the target; a double click or Enter closes the outline.",
  reference: "Drag a box around something that stands still.",
  ruler: "Drag along a length that you know.",
  exclude: "Drag a box over what moves with the target and is not part of it.",
  obstacles: "Drag a box over something that stands still before the target.",
  repair: "Choose frames on the time line; then drag a box around the target in one of them. Without, a click marks it in this frame alone.",
};
