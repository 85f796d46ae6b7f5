// Icons of the page as inline SVG, 16 x 16, drawn with the colour of the text.

import { html } from "../vendor/preact-htm.js";

const PATHS = {
  undo: "M6 3 2.5 6.5 6 10M3 6.5h6.5a3.5 3.5 0 0 1 0 7H6",
  redo: "M10 3l3.5 3.5L10 10M13 6.5H6.5a3.5 3.5 0 0 0 0 7H10",
  run: "M4.5 2.5v11l9-5.5z",
  cancel: "M4 4l8 8M12 4l-8 8",
  report: "M4 1.5h5.5L13 5v9.5H4zM9.5 1.5V5H13M6 8h5M6 10.5h5",
  download: "M8 2v8M4.5 6.8 8 10.2l3.5-3.4M2.5 13.5h11",
  light: "M8 5.2a2.8 2.8 0 1 0 0 5.6 2.8 2.8 0 0 0 0-5.6M8 1v1.6M8 13.4V15M1 8h1.6M13.4 8H15M3 3l1.2 1.2M11.8 11.8 13 13M13 3l-1.2 1.2M4.2 11.8 3 13",
  dark: "M13.5 9.5A6 6 0 0 1 6.5 2.5a6 6 0 1 0 7 7z",
  help: "M5.8 6a2.2 2.2 0 1 1 3.3 1.9c-.8.5-1.1.9-1.1 1.8M8 12.3v.2",
  film: "M2 3h12v10H2zM5 3v10M11 3v10M2 6.3h3M2 9.7h3M11 6.3h3M11 9.7h3",
  target: "M2.5 5.5v-3h3M10.5 2.5h3v3M13.5 10.5v3h-3M5.5 13.5h-3v-3M8 6v4M6 8h4",
  polygon: "M3 6.5 8 2.5l5.5 4-2 6.5h-7z",
  reference: "M8 2v12M2 8h12M8 5.5a2.5 2.5 0 1 0 0 5 2.5 2.5 0 0 0 0-5",
  ruler: "M1.8 10.5 10.5 1.8l3.7 3.7-8.7 8.7zM4.5 7.8l1.5 1.5M6.7 5.6l2 2M8.9 3.4l1.5 1.5",
  obstacle: "M2 13h12M4 13V5h3v8M9 13V3h3v10",
  exclude: "M3 3h10v10H3zM3 9l6-6M3 13 13 3M7 13l6-6",
  repair: "M2.5 13.5l6-6M8.5 7.5a3.2 3.2 0 0 1 4-4.3L10.6 5.1l.3 1.1 1.1.3 1.9-1.9a3.2 3.2 0 0 1-4.3 4M2.5 13.5l1 1",
  warn: "M8 2 1.5 13.5h13zM8 6.5v3.5M8 11.8v.2",
  bad: "M8 1.5a6.5 6.5 0 1 0 0 13 6.5 6.5 0 0 0 0-13M8 4.5v4.3M8 11v.2",
  good: "M3 8.5l3.3 3.3L13 4.8",
  add: "M8 3v10M3 8h10",
  remove: "M3 8h10",
  more: "M3.5 6l4.5 4.5L12.5 6",
  folder: "M1.8 3.5h4.5l1.5 2h6.4v7.5H1.8z",
  sample: "M6 1.8v4.5L2.5 13.5h11L10 6.3V1.8M4.8 1.8h6.4M4.6 10h6.8",
  search: "M7 2.5a4.5 4.5 0 1 0 0 9 4.5 4.5 0 0 0 0-9M10.3 10.3l3.5 3.5",
  auto: "M8 2.2l1.3 3.5 3.5 1.3-3.5 1.3L8 11.8 6.7 8.3 3.2 7l3.5-1.3zM12.5 11v3M11 12.5h3",
};

export const Icon = ({ name, label }) => html`
  <svg class="ui-icon" viewBox="0 0 16 16" role=${label ? "img" : null} aria-label=${label} aria-hidden=${label ? null : "true"}>
    <path d=${PATHS[name]} />
  </svg>`;

export const Spinner = ({ label }) => html`<span class="ui-spinner" role=${label ? "img" : null} aria-label=${label}></span>`;
