// Random edits of every kind to a document, each undone and done again; run in the page by test_designer.py.
async ([seed, steps, document]) => {
  const { Model } = await own("design/model.js");
  const { clip, paste } = await own("design/clip.js");
  const { groups, around } = await own("design/macros.js");
  const { arcsOf } = await own("design/arcs.js");
  let state = seed;
  const random = (n) => (state = (state * 1103515245 + 12345) % 2147483648) % n;
  const model = new Model(() => {});
  model.load({ name: "x", revision: "1", document });
  const states = [JSON.stringify(model.data)];
  const wrong = [];
  const one = (list) => list[random(list.length)];
  const some = () => new Set(Array.from({ length: 4 }, () => one(names())).filter(Boolean));
  const names = () => { const p = model.picture(); return [...p.places, ...p.transitions].map((e) => e.name); };
  const acts = [
    () => model.addPlace(one(["action", "resource", "control", "macro"]), random(900), random(600)),
    () => model.addTransition(random(900), random(600)),
    () => model.connect(one(names()), one(names()), random(5) === 0),
    () => model.connect(one(names()), one(names())),
    () => { const arc = one(model.picture().arcs); if (arc && !arc.inner.length) model.setArc(arc, { weight: 1 + random(3) }); },
    () => random(3) || model.remove(new Set([one(names())]), []),
    () => { const arc = one(model.picture().arcs); if (arc) model.remove(new Set(), [arc]); },
    () => model.move(Object.fromEntries([...some()].map((n) => [n, [random(900), random(600)]]))),
    () => model.set(one(names()), { label: `l${random(9)}` }),
    () => model.rename(one(names()), one(["größe", "constructor", `n${random(99)}`, "bad name", "__proto__"])),
    () => { const p = one(names()); if (model.place(p)?.kind === "action") model.choosePrimitiveTask(p, "pick", [{ action: "pick", primitive_task: "pick" }]); },
    () => { const p = one(names()); if (model.place(p)?.kind === "action") model.addExit(p, one(["normal", "error"]), 5, 5); },
    () => paste(model, clip(model, some()), 40, 60),
    () => model.group(some()), () => model.group(some()), () => model.ungroup(new Set(names())),
    () => model.open(model.sheet, one(names())), () => model.open("", ""),
    () => { const p = one(names()); if (groups(model.place(p)) && !model.picture().arcs.some((a) => a.place === p)) model.open(model.addSubnet(p) ?? ""); },
  ];
  for (let i = 0; i < steps; i++) {
    if (!names().length) model.addPlace("control", 1, 1);
    one(acts)();
    const text = JSON.stringify(model.data);
    if (text !== states.at(-1)) states.push(text);
    for (const net of [model.data, ...Object.values(model.data.subnets ?? {})]) {
      const all = [...Object.entries(net.places ?? {}), ...Object.entries(net.transitions ?? {})];
      for (const [name, e] of all) if (e.macro && (!Object.hasOwn(net.places, e.macro) || around(net, name).includes(name))) wrong.push(`${name} in ${e.macro}`);
      for (const [name, t] of Object.entries(net.transitions ?? {})) for (const arc of arcsOf(t)) if (!Object.hasOwn(net.places, arc.place)) wrong.push(`${name} with ${arc.place}`);
    }
  }
  const last = states.at(-1);
  for (const wanted of [...states].reverse().slice(1)) { model.undo(); if (JSON.stringify(model.data) !== wanted) wrong.push("undo"); }
  while (model.redo());
  if (JSON.stringify(model.data) !== last) wrong.push("redo");
  return { wrong: wrong.slice(0, 5), steps: states.length, final: model.data };
}
