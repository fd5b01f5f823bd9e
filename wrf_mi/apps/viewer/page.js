"use strict";
// The page of a view. Data are in the element "content" (wrf_mi/apps/viewer/page.py); every layer makes its traces anew from
// the state, and plotly draws those of the layers that are switched on.
(() => {
  const data = JSON.parse(document.getElementById("content").textContent);

  const plotlyScale = (name) => data.scales[name].map((colour, i, all) => [i / (all.length - 1), colour]);
  const state = { receiver: 0, chosen: 0, mesh: 0.35 };
  const layers = [];
  const receivers = { names: data.receivers, position: unpack(data.receivers_m).values };

  // A layer: its name, whether it is on, a swatch or a colour scale, options below its name, and its traces.
  function addLayer(layer) {
    layers.push({ on: true, ...layer });
  }

  // --- held-out rows and the chosen transmitter --------------------------------------------------------------------------
  const rows = data.rows && {
    row: unpack(data.rows.row).values,
    position: unpack(data.rows.tx_pos_m).values,
    score: unpack(data.rows.score).values,
    stored: unpack(data.rows.stored).values,
  };
  const scoreOf = (index) => rows.score[state.receiver * rows.row.length + index];
  const scoreText = (value) => `${data.rows.label} ${number(value, data.rows.digits)}`;
  const rowText = (index) => `row ${rows.row[index]}, ${scoreText(scoreOf(index))}`;

  function rowMarkers(indices, marker, more = {}) {
    const scale = plotlyScale("error");
    const [low, high] = data.rows.range;
    const known = indices.filter((i) => Number.isFinite(scoreOf(i)));
    const silent = indices.filter((i) => !Number.isFinite(scoreOf(i)));
    const common = (chosen) => ({ type: "scatter3d", mode: "markers", ...xyz(chosen.flatMap((i) => at(rows.position, i))) });
    const hover = (chosen) => ({ text: chosen.map((i) => plain(rowText(i))), hovertemplate: "%{text}<extra></extra>" });
    const coloured = {
      color: known.map(scoreOf),
      cmin: low,
      cmax: high,
      colorscale: data.rows.higher_is_better ? reversed(scale) : scale,
    };
    return [
      { ...common(known), ...hover(known), ...more, customdata: known, marker: { ...marker, ...coloured } },
      { ...common(silent), ...hover(silent), ...more, customdata: silent, marker: { ...marker, color: "#b8bcc4" } },
    ].filter((trace) => trace.x.length);
  }

  if (rows) {
    const all = Array.from(rows.row, (_, i) => i);
    const chosenRows = Array.from(rows.stored);
    addLayer({
      name: `held-out rows (${all.length})`,
      scale: () => ["error", data.rows.range, data.rows.label, data.rows.higher_is_better],
      traces: () => rowMarkers(all, { size: 3, line: { width: 0 } }),
    });
    addLayer({
      name: `transmitters that can be chosen (${chosenRows.length})`,
      swatch: data.ends.transmitter,
      traces: () => [
        ...rowMarkers(chosenRows, { size: 6, symbol: "diamond", line: { width: 1, color: "#333" } }),
        {
          type: "scatter3d",
          mode: "markers",
          ...xyz(at(rows.position, rows.stored[state.chosen])),
          marker: { size: 9, color: data.ends.transmitter, symbol: "diamond", line: { width: 1, color: "#fff" } },
          text: [plain(rowText(rows.stored[state.chosen]))],
          hovertemplate: "transmitter, %{text}<extra></extra>",
        },
      ],
    });
  }

  // --- receivers ------------------------------------------------------------------------------------------------------
  if (receivers.position.some(Number.isFinite)) {
    addLayer({
      name: `receivers (${receivers.names.length})`,
      swatch: data.ends.receiver,
      traces: () => [
        {
          type: "scatter3d",
          mode: "markers",
          ...xyz(receivers.position),
          marker: {
            size: receivers.names.map((_, i) => (i === state.receiver ? 9 : 6)),
            color: data.ends.receiver,
            line: { width: 1, color: "#fff" },
          },
          text: receivers.names.map(plain),
          hovertemplate: "receiver %{text}<extra></extra>",
        },
      ],
    });
  }

  // --- paths ----------------------------------------------------------------------------------------------------------
  const paths = data.paths && Object.fromEntries(
    ["tx", "rx", "order", "kind", "gain_db", "length_m", "corners_m"].map((name) => [name, unpack(data.paths[name]).values]));
  if (paths && paths.tx.length) {
    const first = [0];
    for (const order of paths.order) first.push(first[first.length - 1] + order + 2);
    const orders = [...new Set(paths.order)].sort((a, b) => a - b);
    const top = paths.gain_db.reduce((a, b) => Math.max(a, b));
    const bottom = paths.gain_db.reduce((a, b) => Math.min(a, b));
    const range = [Math.max(bottom, top - data.span_db), top];
    state.orders = new Set(orders);
    const least = Math.max(Math.floor(bottom), Math.ceil(top) - 3 * data.span_db);
    state.weakest = Math.max(least, Math.floor(range[0]));
    addLayer({
      name: "paths of the transmitter to the receiver",
      scale: () => ["gain", range, "gain (dB)"],
      options: () => [
        element("div", { className: "orders" }, "Interactions:", ...orders.map(orderBox)),
        slider("Smallest gain (dB)", least, Math.ceil(top), 1, state.weakest, (v) => (state.weakest = v), (v) => (v > least ? number(v, 0) : "all")),
      ],
      traces: () => {
        const points = [];
        const colours = [];
        const texts = [];
        for (let p = 0; p < paths.tx.length; p++) {
          const shown = paths.tx[p] === state.chosen && paths.rx[p] === state.receiver;
          if (!shown || !state.orders.has(paths.order[p]) || (state.weakest > least && paths.gain_db[p] < state.weakest)) continue;
          const kind = data.paths.kinds[paths.kind[p]];
          const text = plain(`${kind}: ${number(paths.gain_db[p])} dB, ${number(paths.length_m[p], 2)} m`);
          for (let v = first[p]; v < first[p + 1]; v++) {
            points.push(...at(paths.corners_m, v));
            colours.push(paths.gain_db[p]);
            texts.push(text);
          }
          points.push(NaN, NaN, NaN);
          colours.push(paths.gain_db[p]);
          texts.push("");
        }
        const line = { width: 3, color: colours, colorscale: plotlyScale("gain"), cmin: range[0], cmax: range[1] };
        if (!points.length) return [];
        return [{ type: "scatter3d", mode: "lines", ...xyz(points), line, text: texts, hovertemplate: "%{text}<extra></extra>" }];
      },
    });
  }

  function orderBox(order) {
    const box = element("input", { type: "checkbox", checked: true });
    box.addEventListener("change", () => {
      if (box.checked) state.orders.add(order);
      else state.orders.delete(order);
      draw();
    });
    return element("label", {}, box, ` ${order}`);
  }

  // --- Gaussians ------------------------------------------------------------------------------------------------------
  const gaussians = data.gaussians && Object.fromEntries(
    ["position_m", "log_scale", "rotation_xyzw", "strength_db"].map((name) => [name, unpack(data.gaussians[name])]));
  if (gaussians) {
    const count = gaussians.position_m.shape[0];
    const sphere = icosphere();
    const top = gaussians.strength_db.values.reduce((a, b) => Math.max(a, b));
    const bottom = gaussians.strength_db.values.reduce((a, b) => Math.min(a, b));
    const range = [Math.max(bottom, top - data.span_db), top];
    state.gaussians = Math.min(count, 200);
    addLayer({
      name: `Gaussians (${count} of ${data.gaussians.total}), at one standard deviation`,
      scale: () => ["strength", range, "signal (dB)"],
      options: () => [slider("Strongest", 1, count, 1, state.gaussians, (v) => (state.gaussians = v))],
      traces: () => {
        const made = ellipsoids(state.chosen, state.gaussians, sphere);
        return [{
          type: "mesh3d", ...made, opacity: 0.4, colorscale: plotlyScale("strength"), cmin: range[0], cmax: range[1],
          showscale: false, lighting: { ambient: 0.85, diffuse: 0.3, specular: 0 }, hovertemplate: "%{text}<extra></extra>",
        }];
      },
    });
  }

  function ellipsoids(transmitter, shown, sphere) {
    const count = gaussians.position_m.shape[0];
    const slot = gaussians.log_scale.shape[0] > 1 ? transmitter : 0;
    const vertices = sphere.vertices.length;
    const made = { x: [], y: [], z: [], i: [], j: [], k: [], intensity: [], text: [] };
    for (let g = 0; g < shown; g++) {
      const centre = at(gaussians.position_m.values, g);
      const scale = at(gaussians.log_scale.values, slot * count + g).map(Math.exp);
      const start = 4 * (slot * count + g);
      const turn = rotation(...gaussians.rotation_xyzw.values.subarray(start, start + 4));
      const strength = gaussians.strength_db.values[transmitter * count + g];
      const text = `${number(strength)} dB`;
      for (const unit of sphere.vertices) {
        const local = unit.map((value, axis) => value * scale[axis]);
        for (const [axis, name] of [[0, "x"], [1, "y"], [2, "z"]]) {
          made[name].push(centre[axis] + turn[axis][0] * local[0] + turn[axis][1] * local[1] + turn[axis][2] * local[2]);
        }
        made.intensity.push(strength);
        made.text.push(text);
      }
      for (const [a, b, c] of sphere.faces) {
        made.i.push(g * vertices + a);
        made.j.push(g * vertices + b);
        made.k.push(g * vertices + c);
      }
    }
    return made;
  }

  // --- maps -----------------------------------------------------------------------------------------------------------
  if (data.maps.length) {
    const maps = data.maps.map((one) => ({
      ...one,
      x: unpack(one.x_m).values,
      y: unpack(one.y_m).values,
      z: one.z_m && unpack(one.z_m).values,
      values: Object.fromEntries(Object.entries(one.values).map(([name, packed]) => [name, unpack(packed)])),
    }));
    maps.sort((a, b) => (a.height_m ?? Infinity) - (b.height_m ?? Infinity));
    const names = Object.keys(data.quantities);
    Object.assign(state, { quantity: names[0], map: 0, mapOpacity: 0.9 });
    const title = (one) => (one.z ? `points (${one.name})` : `${number(one.height_m, 2)} m (${one.name})`);
    addLayer({
      name: maps.length > 1 ? `maps (${maps.length})` : `map at ${title(maps[0])}`,
      scale: () => ["map", data.quantities[state.quantity].range, data.quantities[state.quantity].label],
      options: () => [
        choice("Quantity", names.map((name) => data.quantities[name].label), 0, (i) => (state.quantity = names[i])),
        ...(maps.length > 1 ? [slider("Height", 0, maps.length - 1, 1, 0, (v) => (state.map = v), (v) => title(maps[v]))] : []),
        slider("Opacity", 0.1, 1, 0.05, 0.9, (v) => (state.mapOpacity = v)),
      ],
      traces: () => mapTraces(maps[state.map]),
    });
  }

  function mapTraces(one) {
    const found = one.values[state.quantity];
    if (!found) return [];
    const [cmin, cmax] = data.quantities[state.quantity].range;
    const size = found.values.length / found.shape[0];
    const named = one.receivers.indexOf(receivers.names[state.receiver]);
    const slot = found.shape[0] > 1 ? named : 0;
    if (slot < 0) return [];
    const values = found.values.subarray(slot * size, (slot + 1) * size);
    const label = plain(data.quantities[state.quantity].label);
    const shared = { opacity: state.mapOpacity, hovertemplate: `${label}: %{text}<extra></extra>` };
    const scale = { cmin, cmax, colorscale: plotlyScale("map") };
    if (one.z) {
      const text = Array.from(values, (v) => number(v, 2));
      const marker = { size: 4, color: Array.from(values), ...scale };
      return [{ type: "scatter3d", mode: "markers", x: one.x, y: one.y, z: one.z, marker, text, ...shared }];
    }
    const width = one.x.length;
    const lines = (each) => Array.from(one.y, (_, r) => Array.from(values.subarray(r * width, (r + 1) * width), each));
    return [{
      type: "surface", x: one.x, y: one.y, z: lines((v) => (Number.isFinite(v) ? one.height_m : null)), surfacecolor: lines((v) => v),
      text: lines((v) => number(v, 2)), showscale: false, lighting: { ambient: 1, diffuse: 0, specular: 0 }, ...scale, ...shared,
    }];
  }

  const meshOptions = () => [slider("Opacity of the mesh", 0.05, 1, 0.05, state.mesh, (v) => (state.mesh = v))];

  // --- mesh -----------------------------------------------------------------------------------------------------------
  const meshes = data.scene ? data.scene.meshes : [];
  for (const [place, mesh] of meshes.entries()) {
    const corners = unpack(mesh.corners_m).values;
    const surface = unpack(mesh.surface).values;
    const triangles = surface.length;
    const every = (k) => Int32Array.from({ length: triangles }, (_, t) => 3 * t + k);
    const trace = {
      type: "mesh3d",
      ...xyz(corners),
      i: every(0),
      j: every(1),
      k: every(2),
      color: data.colours[mesh.material],
      flatshading: true,
      lighting: { ambient: 0.75, diffuse: 0.5, specular: 0.05, facenormalsepsilon: 0, vertexnormalsepsilon: 0 },
      text: Array.from({ length: 3 * triangles }, (_, v) => plain(mesh.names[surface[Math.floor(v / 3)]])),
      hovertemplate: `%{text}<br>${plain(mesh.material)}<extra></extra>`,
    };
    addLayer({
      name: mesh.ceiling ? `${mesh.material}, ceiling` : mesh.material,
      on: !mesh.ceiling,
      swatch: data.colours[mesh.material],
      options: place === meshes.length - 1 ? meshOptions : null,
      traces: () => [{ ...trace, opacity: state.mesh }],
    });
  }
  if (data.scene && data.scene.edges_m.shape[0]) {
    const ends = unpack(data.scene.edges_m).values;
    const lines = [];
    for (let i = 0; i < ends.length; i += 6) lines.push(ends.subarray(i, i + 3), ends.subarray(i + 3, i + 6), [NaN, NaN, NaN]);
    const trace = { type: "scatter3d", mode: "lines", ...xyz(lines.flatMap((p) => [...p])), hoverinfo: "skip" };
    addLayer({
      name: "edges",
      swatch: "#2b2d42",
      traces: () => [{ ...trace, line: { color: "#2b2d42", width: 1.5 } }],
    });
  }

  // --- observations of the chosen transmitter ------------------------------------------------------------------------------
  function drawObservation() {
    const observed = data.rows.observed;
    const index = rows.stored[state.chosen];
    const receiver = receivers.names[state.receiver];
    document.getElementById("observation-title").textContent = `${rowText(index)}, ${receiver}`;
    const layout = {
      margin: { l: 44, r: 8, t: 22, b: 34 }, showlegend: true, legend: { orientation: "h", x: 0, y: 1.15 },
      font: { size: 11 }, paper_bgcolor: "#fff", plot_bgcolor: "#fff",
    };
    const kinds = ["measured", "predicted"];
    let traces;
    if (observed.kind === "image") {
      [traces, layout.showlegend, layout.images] = [[], false, []];
      layout.grid = { rows: 2, columns: 1, pattern: "independent", ygap: 0.35 };
      layout.annotations = kinds.map((kind, k) => ({
        text: kind, showarrow: false, xref: `x${k ? 2 : ""} domain`, yref: `y${k ? 2 : ""} domain`, x: 0, y: 1, yanchor: "bottom", xanchor: "left",
      }));
      kinds.forEach((kind, k) => {
        const source = observed[kind][state.receiver][state.chosen];
        const [height, width] = observed.size;
        const [x, y] = [`x${k ? 2 : ""}`, `y${k ? 2 : ""}`];
        // Samples are points: each pixel reaches half a step to either side of its own.
        const place = { x: -180 / width, y: 90 - 45 / height, sizex: 360, sizey: 90, sizing: "stretch", layer: "below" };
        if (source) layout.images.push({ source, xref: x, yref: y, ...place });
        traces.push({ type: "scatter", x: [null], y: [null], xaxis: x, yaxis: y });
        layout[`xaxis${k ? 2 : ""}`] = { range: [0, 360], dtick: 90, showgrid: false, title: k ? { text: "azimuth (°)" } : undefined };
        layout[`yaxis${k ? 2 : ""}`] = { range: [0, 90], dtick: 30, showgrid: false, zeroline: false, title: { text: "elevation (°)" } };
      });
    } else if (observed.kind === "level") {
      traces = kinds.map((kind, k) => ({
        type: "scatter", mode: "markers", name: kind, x: receivers.names.map(plain), marker: { size: 10, symbol: k ? "x" : "circle" },
        y: receivers.names.map((_, r) => level[kind].values[r * rows.stored.length + state.chosen]),
      }));
      layout.yaxis = { title: { text: plain(data.rows.quantity) } };
    } else {
      traces = kinds.map((kind, k) => {
        const size = level[kind].shape[2];
        const start = (state.receiver * rows.stored.length + state.chosen) * size;
        const y = Array.from(level[kind].values.subarray(start, start + size));
        return { type: "scatter", mode: size > 1 ? "lines" : "markers", name: kind, y, line: { dash: k ? "dash" : "solid" } };
      });
      layout.xaxis = { title: { text: "subcarrier" } };
      layout.yaxis = { title: { text: plain(data.rows.quantity) } };
    }
    return Plotly.react("observation", traces, layout, { responsive: true, displayModeBar: false });
  }
  const level = rows && data.rows.observed.kind !== "image"
    ? { measured: unpack(data.rows.observed.measured), predicted: unpack(data.rows.observed.predicted) } : null;

  // --- controls -------------------------------------------------------------------------------------------------------
  function slider(name, min, max, step, value, set, text = (v) => number(v, step < 1 ? 2 : 0)) {
    const output = element("output", { textContent: text(value) });
    const input = element("input", { type: "range", min, max, step, value });
    input.addEventListener("input", () => {
      set(Number(input.value));
      output.textContent = text(Number(input.value));
      draw();
    });
    return element("label", {}, `${name}: `, output, input);
  }

  function choice(name, options, value, set) {
    const select = element("select", {}, ...options.map((text, i) => element("option", { value: i, textContent: text, selected: i === value })));
    select.addEventListener("change", () => {
      set(Number(select.value));
      drawScales();
      draw();
    });
    return element("label", {}, `${name} `, select);
  }

  function drawScales() {
    for (const layer of layers) {
      if (!layer.scale) continue;
      const [name, [low, high], label, flipped] = layer.scale();
      const colours = flipped ? [...data.scales[name]].reverse() : data.scales[name];
      const bar = element("div", { className: "bar" });
      bar.style.background = `linear-gradient(to right, ${colours.join(", ")})`;
      const digits = high > low ? Math.min(6, Math.max(0, 1 - Math.floor(Math.log10(high - low)))) : 1;
      const ends = [number(low, digits), label, number(high, digits)].map((text) => element("span", { textContent: text }));
      layer.bar.replaceChildren(bar, element("div", { className: "ends" }, ...ends));
    }
  }

  for (const layer of layers) {
    const box = element("input", { type: "checkbox", checked: layer.on });
    box.addEventListener("change", () => {
      layer.on = box.checked;
      draw();
    });
    const name = element("label", { className: "layer" }, box);
    if (layer.swatch) {
      const swatch = element("span", { className: "swatch" });
      swatch.style.background = layer.swatch;
      name.append(swatch);
    }
    name.append(element("span", { textContent: layer.name }));
    document.getElementById("layers").append(name);
    if (layer.scale) document.getElementById("layers").append((layer.bar = element("div", { className: "scale" })));
    if (layer.options) document.getElementById("layers").append(element("div", { className: "option" }, ...layer.options()));
  }
  drawScales();

  const choices = document.getElementById("choices");
  if (receivers.names.length > 1) choices.append(choice("Receiver", receivers.names, 0, (i) => (state.receiver = i)));
  let steps = null;
  if (rows) {
    document.getElementById("observation-part").hidden = false;
    const text = (i) => `row ${rows.row[rows.stored[i]]}`;
    steps = slider("Transmitter", 0, rows.stored.length - 1, 1, 0, (v) => (state.chosen = v), text);
    choices.append(steps);
  }
  choices.hidden = !choices.children.length;
  if (data.notes.length) {
    document.getElementById("notes-part").hidden = false;
    document.getElementById("notes").append(...data.notes.map((text) => element("li", { textContent: text })));
  }

  // --- drawing --------------------------------------------------------------------------------------------------------
  const axis = (name) => ({ title: { text: `${name} (m)` }, backgroundcolor: "#fff", gridcolor: "#e5e7eb", zeroline: false, showspikes: false });
  const layout = {
    margin: { l: 0, r: 0, t: 0, b: 0 }, showlegend: false, uirevision: "kept", hoverlabel: { align: "left" },
    scene: { aspectmode: "data", xaxis: axis("x"), yaxis: axis("y"), zaxis: axis("z"), camera: { eye: { x: 1.05, y: -1.55, z: 1.35 }, projection: { type: "perspective" } } },
  };
  const config = { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["resetCameraLastSave3d"] };
  const THINNEST = 0.05; // smallest edge of the box to its largest: Plotly's camera cannot see all of much thinner ones
  const LABELS = 1.15; // room around the box for the labels of its axes
  const frame = []; // two invisible points
  let pending = false;

  function drawNow() {
    pending = false;
    const shown = layers.filter((layer) => layer.on).flatMap((layer) => layer.traces());
    const scene = Plotly.react("scene", [...shown, ...frame], layout, config);
    return Promise.all([scene, rows ? drawObservation() : null]);
  }

  function draw() {
    if (pending) return;
    pending = true;
    requestAnimationFrame(drawNow);
  }

  drawNow().then(() => {
    const scene = document.getElementById("scene");
    scene.on("plotly_click", (event) => {
      const place = rows ? Array.from(rows.stored).indexOf(event.points[0].customdata) : -1;
      if (place < 0) return;
      const input = steps.querySelector("input");
      input.value = place;
      input.dispatchEvent(new Event("input"));
    });
    const ranges = ["x", "y", "z"].map((name) => scene._fullLayout.scene[`${name}axis`].range);
    const thickness = THINNEST * Math.max(...ranges.map(([low, high]) => high - low));
    const ends = [-thickness, thickness].map((by) => ranges.map(([low, high]) => (low + high + by) / 2));
    frame.push({ type: "scatter3d", mode: "markers", ...xyz(ends.flat()), marker: { opacity: 0 }, hoverinfo: "skip" });
    return drawNow();
  }).then(([scene]) => {
    // Plotly gives all boxes one volume, so that long and flat ones reach further out of a picture.
    const eye = Object.values(layout.scene.camera.eye);
    const { x, y, z } = scene._fullLayout.scene.aspectratio;
    const scale = (LABELS * viewingDistance([x, y, z], eye, scene.clientWidth / scene.clientHeight)) / Math.hypot(...eye);
    return Plotly.relayout(scene, { "scene.camera.eye": Object.fromEntries(eye.map((value, i) => ["xyz"[i], scale * value])) });
  }).then(() => {
    document.body.dataset.ready = "true";
  });
})();
