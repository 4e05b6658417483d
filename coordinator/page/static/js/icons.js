// The page's icons: 24 x 24 outlines, drawn for this page.

import { s } from "./dom.js";

const PATHS = {
  play: "M8 5.5v13l10.5-6.5z",
  pause: "M8.5 5.5v13M15.5 5.5v13",
  step: "M6 5.5v13l8.5-6.5zM18 5.5v13",
  resume: "M5.5 5.5v13M10 5.5v13l9-6.5z",
  abort: "M6.5 6.5h11v11h-11z",
  stop: "M8.3 3h7.4L21 8.3v7.4L15.7 21H8.3L3 15.7V8.3zM8.5 12h7",
  token: "M12 7.5a4.5 4.5 0 1 0 0 9 4.5 4.5 0 0 0 0-9z",
  plus: "M12 5.5v13M5.5 12h13",
  minus: "M5.5 12h13",
  bolt: "M13 3 5.5 13.5H11L10 21l8-11h-5.8z",
  exit: "M14 4.5H5.5v15H14M10 12h10.5M16.5 7.5 21 12l-4.5 4.5",
  dot: "M12 6.5a5.5 5.5 0 1 0 0 11 5.5 5.5 0 0 0 0-11z",
  hand: "M8 12.5V6.2a1.6 1.6 0 0 1 3.2 0V11m0-.5V4.6a1.6 1.6 0 0 1 3.2 0V11m0-4.2a1.6 1.6 0 0 1 3.2 0v8.7a5.5 5.5 0 0 1-5.5 5.5c-3 0-4.3-1.4-5.6-3.6L4 13.2c-.7-1.4 1-2.7 2.2-1.6L8 13.6",
  eye: "M2.5 12S6 5.8 12 5.8 21.5 12 21.5 12 18 18.2 12 18.2 2.5 12 2.5 12zM12 9.2a2.8 2.8 0 1 0 0 5.6 2.8 2.8 0 0 0 0-5.6z",
  search: "M10.5 4.5a6 6 0 1 0 0 12 6 6 0 0 0 0-12zM15 15l5 5",
  fit: "M4 9V4h5M15 4h5v5M20 15v5h-5M9 20H4v-5",
  sun: "M12 8a4 4 0 1 0 0 8 4 4 0 0 0 0-8zM12 2.5v2.2M12 19.3v2.2M2.5 12h2.2M19.3 12h2.2M5.3 5.3l1.6 1.6M17.1 17.1l1.6 1.6M18.7 5.3l-1.6 1.6M6.9 17.1l-1.6 1.6",
  moon: "M19.5 14.2A8 8 0 0 1 9.8 4.5a8 8 0 1 0 9.7 9.7z",
  wall: "M3 5h18v11.5H3zM9 20h6M12 16.5V20",
  undo: "M8.5 5 4 9.5 8.5 14M4.5 9.5H14a5.5 5.5 0 0 1 0 11h-3.5",
  redo: "M15.5 5 20 9.5 15.5 14M19.5 9.5H10a5.5 5.5 0 0 0 0 11h3.5",
  copy: "M9 9h11v11H9zM15 9V4H4v11h5",
  paste: "M9 4.5H5.5v16h13v-16H15M9 3.5h6v3H9z",
  trash: "M4.5 6.5h15M9.5 6.5V4h5v2.5M6.5 6.5l1 14h9l1-14M10 10.5v6M14 10.5v6",
  select: "M5.5 3.5v15l4-4 2.7 6 2.6-1.2-2.7-5.8h5.7z",
  arc: "M4 18C7 9 12 6.5 19 6.5M14 3l5 3.5-4 4.5",
  inhibitor: "M4 18C6.5 11 10 8.3 14.5 7.6M17.5 4.6a2.7 2.7 0 1 0 0 5.4 2.7 2.7 0 0 0 0-5.4z",
  action: "M12 3.5a8.5 8.5 0 1 0 0 17 8.5 8.5 0 0 0 0-17zM10 8.5v7l5.5-3.5z",
  resource: "M12 3.5a8.5 8.5 0 1 0 0 17 8.5 8.5 0 0 0 0-17z",
  plain: "M12 3.5a8.5 8.5 0 1 0 0 17 8.5 8.5 0 0 0 0-17z",
  control: "M12 3.5a8.5 8.5 0 1 0 0 17 8.5 8.5 0 0 0 0-17zM12 7a5 5 0 1 0 0 10 5 5 0 0 0 0-10z",
  macro: "M12 3.5a8.5 8.5 0 1 0 0 17 8.5 8.5 0 0 0 0-17zM8.8 8.8h6.4v6.4H8.8z",
  transition: "M10 3.5h4v17h-4z",
  layout: "M3.5 9.5h5v5h-5zM15.5 4h5v5h-5zM15.5 15h5v5h-5zM8.5 12h3.5V6.5h3.5M12 12v5.5h3.5",
  alignLeft: "M4 3.5v17M7.5 6.5h11v4h-11zM7.5 14h7v4h-7z",
  alignRow: "M3.5 12h17M6 7.5h4v9H6zM14 5h4v14h-4z",
  distribute: "M4 4v16M20 4v16M10 7.5h4v9h-4z",
  save: "M4.5 4.5h12l3 3v12h-15zM8 4.5v5h7v-5M8 19.5v-6h8v6",
  open: "M3.5 19.5v-14h6l2 2.5h9v11.5z",
  more: "M5.5 12h.01M12 12h.01M18.5 12h.01",
  fold: "M6 4v9a3 3 0 0 0 3 3h9M6 20v-7M14.5 12.5 18 16l-3.5 3.5",
  check: "M5 12.5 10 17.5 19.5 7",
  warning: "M12 4 2.8 20h18.4zM12 10v4.5M12 17.2v.1",
  error: "M12 3.5a8.5 8.5 0 1 0 0 17 8.5 8.5 0 0 0 0-17zM12 7.5v5.5M12 16.2v.1",
  info: "M12 3.5a8.5 8.5 0 1 0 0 17 8.5 8.5 0 0 0 0-17zM12 11v5.5M12 7.8v.1",
  back: "M14.5 5 7.5 12l7 7",
  next: "M9.5 5l7 7-7 7",
  first: "M17.5 5l-7 7 7 7M6.5 5v14",
  last: "M6.5 5l7 7-7 7M17.5 5v14",
  close: "M6 6l12 12M18 6 6 18",
  node: "M4 5h16v6H4zM4 13h16v6H4zM7.5 8v.1M7.5 16v.1",
  clock: "M12 3.5a8.5 8.5 0 1 0 0 17 8.5 8.5 0 0 0 0-17zM12 7.5V12l3.5 2.2",
  link: "M9.5 14.5l5-5M11 6.5l1.7-1.7a4.5 4.5 0 0 1 6.4 6.4L17.5 13M13 17.5l-1.7 1.7a4.5 4.5 0 0 1-6.4-6.4L6.5 11",
  download: "M12 4v11M7 10.5l5 5 5-5M4.5 19.5h15",
  upload: "M12 15.5v-11M7 9l5-5 5 5M4.5 19.5h15",
  compare: "M4 5h7v14H4zM13 5h7v14h-7z",
};

/** An icon; it says nothing to screen readers, its button does. */
export const icon = (name) =>
  s("svg", { class: `icon icon-${name}`, viewBox: "0 0 24 24", "aria-hidden": "true" }, s("path", { d: PATHS[name] ?? PATHS.info }));

/** The outline of an icon, to draw it inside another picture. */
export const iconPath = (name) => PATHS[name];
