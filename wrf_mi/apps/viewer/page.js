"use strict";
// The page of a view. Its figures are Plotly's and come from wrf_mi/apps/viewer/figures.py; a choice of transmitter and
// receiver changes attributes of their traces.
(() => {
  const view = JSON.parse(document.getElementById("content").textContent);
  const [scene, observation, receiver, transmitter] = ["scene", "observation", "receiver", "transmitter"].map((id) => document.getElementById(id));

  const floats = (spec) => new Float32Array(Uint8Array.from(atob(spec.bdata), (c) => c.charCodeAt(0)).buffer);

  // Corners of ellipsoids for a transmitter, each a sphere under the linear map of its Gaussian.
  function ellipsoids({ traces, most, sphere, centres, strengths, axes }, t) {
    const [strength, map] = [floats(strengths[t]), floats(axes[axes.length > 1 ? t : 0])];
    const changes = Object.fromEntries(traces.map((number) => [number, { x: [], y: [], z: [], intensity: [] }]));
    strength.forEach((value, g) => {
      const mesh = changes[traces[Number(g >= most)]];
      for (const unit of sphere) {
        ["x", "y", "z"].forEach((name, row) => mesh[name].push(unit.reduce((sum, u, k) => sum + map[9 * g + 3 * row + k] * u, centres[g][row])));
        mesh.intensity.push(value);
      }
    });
    return changes;
  }

  // All changes in one call, as each call draws the figure anew.
  function change(figure, ...tables) {
    const changes = Object.assign({}, ...tables);
    const numbers = Object.keys(changes);
    const names = new Set(numbers.flatMap((number) => Object.keys(changes[number])));
    const values = [...names].map((name) => [name, numbers.map((number) => changes[number][name])]);
    return numbers.length ? Plotly.restyle(figure, Object.fromEntries(values), numbers.map(Number)) : null;
  }

  let pending = false;
  function show() {
    pending = false;
    const [r, t] = [Number(receiver.value), Number(transmitter.value)];
    const texts = view.texts[t] && [view.rows[t], view.texts[t][r]];
    if (texts) [document.getElementById("row").textContent, document.getElementById("observation-title").textContent] = texts;
    const shapes = view.ellipsoids && ellipsoids(view.ellipsoids, t);
    const pair = view.pairs[t]?.[r];
    return Promise.all([change(scene, view.receivers[r], view.transmitters[t], pair, shapes), pair && change(observation, view.observed[t][r])]);
  }
  const showSoon = () => {
    if (!pending) requestAnimationFrame(show);
    pending = true;
  };

  view.names.forEach((name, number) => receiver.append(new Option(name, number)));
  transmitter.max = view.rows.length - 1;
  receiver.parentElement.hidden = view.names.length < 2;
  transmitter.parentElement.hidden = document.getElementById("observation-part").hidden = !view.rows.length;
  receiver.addEventListener("change", showSoon);
  transmitter.addEventListener("input", showSoon);
  document.getElementById("notes-part").hidden = !view.notes.length;
  for (const note of view.notes) document.getElementById("notes").append(Object.assign(document.createElement("li"), { textContent: note }));

  const config = { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["resetCameraLastSave3d"] };
  // A camera's angle is that of the height of its picture: a narrow one is seen from farther away.
  const { eye } = view.layout.scene.camera;
  for (const axis in eye) eye[axis] *= Math.max(1, scene.clientHeight / scene.clientWidth);
  Promise.all([
    Plotly.newPlot(scene, view.traces, view.layout, config),
    view.rows.length && Plotly.newPlot(observation, view.observedTraces, view.observedLayout, { responsive: true, displayModeBar: false }),
  ]).then(show).then(() => {
    scene.on("plotly_click", ({ points: [point] }) => {
      if (point.curveNumber !== view.choosable) return;
      transmitter.value = point.pointNumber;
      showSoon();
    });
    document.body.dataset.ready = "true";
  });
})();
