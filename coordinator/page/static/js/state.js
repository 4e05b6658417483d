// The mission as this page knows it: the snapshot, altered by changes. The rules are those of coordinator/operator/changes.py.

const FIRINGS_KEPT = 60;
const ENDED_KEPT = 200;
const SAMPLES_KEPT = 300;
const NOTICES_KEPT = 30;

const NAMED = {
  node: ["nodes", "node"],
  event: ["events", "event"],
  variable: ["variables", "value"],
  device: ["devices", "device"],
  image: ["images", "image"],
  report: ["reports", "report"],
  selector: ["selectors", "selector"],
};
const OF_A_RUN = ["progress", "state", "data", "held_since", "held_for"];
const WHOLE = new Set(["breakpoints", "paused", "controls", "result"]);

function append(state, key, entry, kept) {
  state[key].push(entry);
  if (state[key].length > kept) state[key].splice(0, state[key].length - kept);
}

function pick(change, keys) {
  const picked = {};
  for (const key of keys) if (key in change) picked[key] = change[key];
  return picked;
}

const RULES = {
  mission: (state, c) => (state.mission = { ...state.mission, ...c.mission }),
  marking: (state, c) => Object.assign(state.marking, c.marking),
  fired: (state, c) => append(state, "firings", c.firing, FIRINGS_KEPT),
  run_started: (state, c) => (state.runs[c.run.id] = c.run),
  run_progress(state, c) {
    const run = state.runs[c.id];
    if (run) state.runs[c.id] = { ...run, ...pick(c, OF_A_RUN) };
  },
  run_ended(state, c) {
    const run = state.runs[c.id];
    if (!run) return;
    delete state.runs[c.id];
    append(state, "ended", { ...run, ...pick(c, ["status", "ended", "reason", "deferred"]) }, ENDED_KEPT);
  },
  run_judged(state, c) {
    state.ended = state.ended.map((run) => (run.id === c.id ? { ...run, ...pick(c, ["status", "reason"]), deferred: false } : run));
  },
  setpoint(state, c) {
    const known = state.setpoints[c.stream] ?? { samples: [] };
    const samples = [...known.samples, ...(c.samples ?? [])].slice(-SAMPLES_KEPT);
    state.setpoints[c.stream] = { ...known, ...(c.setpoint ?? {}), samples };
  },
  notice: (state, c) => append(state, "notices", c.notice, NOTICES_KEPT),
};

/** Which part of the state a kind of change alters. */
export const PART = {
  mission: "mission", marking: "marking", fired: "firings", run_started: "runs", run_progress: "runs",
  run_ended: "runs", run_judged: "runs", setpoint: "setpoints", notice: "notices",
  ...Object.fromEntries(Object.entries(NAMED).map(([kind, [table]]) => [kind, table])),
  ...Object.fromEntries([...WHOLE].map((kind) => [kind, kind])),
};

/** Alter the state by one change; unknown kinds alter nothing. */
export function apply(state, change) {
  const named = NAMED[change.kind];
  if (named) state[named[0]][change.name] = change[named[1]];
  else if (WHOLE.has(change.kind)) state[change.kind] = change[change.kind];
  else RULES[change.kind]?.(state, change);
}

/** The state before anything is known. */
export const emptyState = () => ({
  sequence: 0, mission: { id: "", state: "idle", mode: "realtime" }, time: 0, task: null, marking: {}, runs: {}, ended: [],
  firings: [], nodes: {}, events: {}, variables: {}, devices: {}, images: {}, setpoints: {}, reports: {}, notices: [],
  breakpoints: [], paused: null, controls: { holder: null, asking: [] }, selectors: {}, result: null, you: "",
});
