// The scope's canvas: a panel for each unit, traces as the server decimated them, two cursors. Frames come as bytes,
// see ScopeView.frame in drive_env/studio/scope_view.py.
(() => {
  "use strict";
  const COLOURS = {
    light: ["#0072b2", "#d55e00", "#007a59", "#a3447f", "#8a6100", "#1f1f1f", "#3a86b8", "#7a3b12"],
    dark: ["#56b4e9", "#ffa94d", "#2cc295", "#e79ac4", "#f0e442", "#e6edf3", "#9ad0f5", "#d99a6c"],
  };
  const DASHES = [[], [], [], [], [7, 3], [7, 3], [2, 3], [2, 3]];
  const LEFT = 66;
  const RIGHT = 12;
  const BOTTOM = 26;
  const GAP = 10;
  const CURSORS = ["A", "B"];
  const scope = (window.studioScope = { cursors: [null, null], active: 0, frames: 0, header: null });
  let canvas, pen, box, line, data, drawn = false;
  const ranges = new Map(); // unit -> [low, high], that do not jump with every frame

  scope.start = (page, cursors) => {
    canvas = document.querySelector(".studio-scope canvas");
    if (!canvas) return setTimeout(() => scope.start(page, cursors), 50);
    scope.cursors = cursors;
    box = canvas.parentElement;
    pen = canvas.getContext("2d");
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const open = () => {
      line = new WebSocket(`${scheme}://${location.host}/studio/scope?page=${encodeURIComponent(page)}`);
      line.binaryType = "arraybuffer";
      line.onopen = tell;
      line.onmessage = (event) => take(event.data);
      line.onclose = () => setTimeout(open, 500);
    };
    open();
    new ResizeObserver(tell).observe(box);
    listen();
  };

  function tell() {
    const columns = Math.max(50, Math.floor(box.clientWidth - LEFT - RIGHT));
    if (line && line.readyState === WebSocket.OPEN) line.send(JSON.stringify({ columns }));
    redraw();
  }

  function take(bytes) {
    const length = new DataView(bytes).getUint32(0, true);
    scope.header = JSON.parse(new TextDecoder().decode(new Uint8Array(bytes, 4, length)));
    scope.frames += 1;
    let place = 4 + length;
    const read = (trace) => {
      const one = (count) => {
        const found = new Int16Array(bytes, place, count);
        place += 2 * count;
        return found;
      };
      trace.lows = one(trace.count);
      trace.highs = trace.thick ? one(trace.count) : trace.lows;
    };
    scope.header.traces.forEach(read);
    scope.header.reference.forEach(read);
    data = scope.header;
    redraw();
  }

  function redraw() {
    if (drawn || !data) return;
    drawn = true;
    requestAnimationFrame(() => {
      drawn = false;
      draw();
    });
  }

  function isDark() {
    return document.body.classList.contains("body--dark");
  }
  function style(name) {
    return getComputedStyle(document.body).getPropertyValue(name).trim();
  }

  // --- scales -----------------------------------------------------------------------------------------------------
  function nice(span, steps) {
    const raw = span / Math.max(1, steps);
    const power = 10 ** Math.floor(Math.log10(raw));
    return [1, 2, 2.5, 5, 10].find((one) => one * power >= raw * 0.999) * power;
  }
  function rangeOf(unit, traces) {
    let low = Infinity;
    let high = -Infinity;
    for (const trace of traces) {
      low = Math.min(low, trace.low);
      high = Math.max(high, trace.high);
    }
    if (!(high >= low)) return ranges.get(unit) || [0, 1];
    let span = high - low;
    const isFlat = span < 1e-9 * Math.max(1, Math.abs(high));
    if (isFlat) span = Math.max(Math.abs(high) * 0.1, 1);
    const room = isFlat ? 0.5 : 0.08;
    const wanted = [low - room * span, high + room * span];
    const old = ranges.get(unit);
    const keeps = old && old[0] <= low && old[1] >= high && old[1] - old[0] < 3 * (wanted[1] - wanted[0]);
    if (!keeps) ranges.set(unit, wanted);
    return ranges.get(unit);
  }
  scope.fit = () => {
    ranges.clear();
    redraw();
  };

  // --- drawing -----------------------------------------------------------------------------------------------------
  function panels() {
    const units = [];
    for (const channel of data.channels) if (!units.includes(channel.unit)) units.push(channel.unit);
    return units;
  }
  function timeToX(t, width) {
    return LEFT + ((t - data.from) / (data.to - data.from || 1)) * (width - LEFT - RIGHT);
  }
  function xToTime(x, width) {
    return data.from + ((x - LEFT) / (width - LEFT - RIGHT)) * (data.to - data.from);
  }

  function draw() {
    const ratio = window.devicePixelRatio || 1;
    const width = box.clientWidth;
    const height = box.clientHeight;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.font = "12px system-ui, sans-serif";
    const units = panels();
    const tall = (height - BOTTOM - GAP * Math.max(0, units.length - 1)) / Math.max(1, units.length);
    units.forEach((unit, k) => panel(unit, k * (tall + GAP), tall, width));
    timeAxis(width, height);
    cursors(width, height);
    const status = document.querySelector(".studio-scope-status");
    if (status && status.textContent !== data.status) status.textContent = data.status;
    readout();
  }

  function panel(unit, top, tall, width) {
    const mine = (trace) => data.channels[trace.channel].unit === unit;
    const traces = data.traces.filter(mine);
    const under = data.reference.filter(mine);
    const [low, high] = rangeOf(unit, traces.concat(under));
    const y = (value) => top + tall - ((value - low) / (high - low)) * tall;
    grid(unit, top, tall, width, low, high, y);
    pen.save();
    pen.beginPath();
    pen.rect(LEFT, top, width - LEFT - RIGHT, tall);
    pen.clip();
    for (const trace of under) plot(trace, y, width, 0.4);
    for (const trace of traces) plot(trace, y, width, 1);
    pen.restore();
  }

  function grid(unit, top, tall, width, low, high, y) {
    pen.strokeStyle = style("--s-line");
    pen.fillStyle = style("--s-soft");
    pen.lineWidth = 1;
    pen.strokeRect(LEFT + 0.5, Math.round(top) + 0.5, width - LEFT - RIGHT - 1, Math.round(tall) - 1);
    pen.textAlign = "right";
    const step = nice(high - low, Math.max(2, tall / 34));
    const digits = Math.max(0, Math.min(6, -Math.floor(Math.log10(step) + 1e-9) + (String(step / 10 ** Math.floor(Math.log10(step))).startsWith("2.5") ? 1 : 0)));
    pen.globalAlpha = 0.7;
    pen.beginPath();
    for (let value = Math.ceil(low / step) * step; value <= high; value += step) {
      const at = Math.round(y(value)) + 0.5;
      pen.moveTo(LEFT, at);
      pen.lineTo(width - RIGHT, at);
    }
    pen.stroke();
    pen.globalAlpha = 1;
    for (let value = Math.ceil(low / step) * step; value <= high; value += step) {
      const at = y(value);
      if (at > top + 8 && at < top + tall - 2) pen.fillText((Math.abs(value) < 1e-6 * step ? 0 : value).toFixed(digits), LEFT - 6, at + 4);
    }
    pen.save();
    pen.textAlign = "center";
    pen.translate(12, top + tall / 2);
    pen.rotate(-Math.PI / 2);
    pen.fillStyle = style("--s-text");
    pen.fillText(unit || "integer", 0, 0);
    pen.restore();
  }

  function timeAxis(width, height) {
    const step = nice(data.to - data.from, Math.max(2, (width - LEFT) / 110));
    const small = data.to - data.from < 0.5;
    pen.fillStyle = style("--s-soft");
    pen.strokeStyle = style("--s-line");
    pen.textAlign = "center";
    pen.globalAlpha = 0.5;
    pen.beginPath();
    const ticks = [];
    for (let t = Math.ceil(data.from / step) * step; t <= data.to + 1e-9; t += step) ticks.push(t);
    for (const t of ticks) {
      const x = Math.round(timeToX(t, width)) + 0.5;
      pen.moveTo(x, 0);
      pen.lineTo(x, height - BOTTOM);
    }
    pen.stroke();
    pen.globalAlpha = 1;
    for (const t of ticks) {
      const x = timeToX(t, width);
      if (x > LEFT + 10 && x < width - 24) pen.fillText(small ? (1000 * t).toFixed(0) : t.toFixed(2), x, height - 10);
    }
    pen.textAlign = "left";
    pen.fillText(`t [${small ? "ms" : "s"}]`, 6, height - 10);
    if (data.triggered && data.from < 0 && data.to > 0) {
      pen.strokeStyle = style("--s-stop");
      pen.setLineDash([5, 4]);
      pen.beginPath();
      const x = Math.round(timeToX(0, width)) + 0.5;
      pen.moveTo(x, 0);
      pen.lineTo(x, height - BOTTOM);
      pen.stroke();
      pen.setLineDash([]);
    }
  }

  function plot(trace, y, width, alpha) {
    pen.strokeStyle = COLOURS[isDark() ? "dark" : "light"][trace.channel];
    pen.globalAlpha = alpha;
    pen.lineWidth = alpha < 1 ? 1.2 : 1.6;
    pen.setLineDash(alpha < 1 ? [3, 3] : DASHES[trace.channel]);
    const value = (one) => y(trace.low + (one + trace.offset) * trace.step);
    pen.beginPath();
    let next = 0;
    let start = trace.from;
    let first = 0;
    for (let k = 0; k < trace.count; k += 1) {
      let broken = k === 0;
      while (next < trace.breaks.length && trace.breaks[next][0] === k) {
        [first, start] = trace.breaks[next];
        next += 1;
        broken = true;
      }
      const x = timeToX(start + (k - first) * trace.every, width);
      const low = value(trace.lows[k]);
      if (broken) pen.moveTo(x, low);
      else pen.lineTo(x, low);
      if (trace.thick) pen.lineTo(x, value(trace.highs[k]));
    }
    pen.stroke();
    pen.setLineDash([]);
    pen.globalAlpha = 1;
  }

  // --- cursors -----------------------------------------------------------------------------------------------------
  function cursors(width, height) {
    scope.cursors.forEach((t, k) => {
      if (t === null) return;
      const x = Math.round(timeToX(t, width)) + 0.5;
      pen.strokeStyle = style("--s-text");
      pen.lineWidth = k === scope.active ? 2 : 1;
      pen.setLineDash(k ? [6, 3] : []);
      pen.beginPath();
      pen.moveTo(x, 0);
      pen.lineTo(x, height - BOTTOM);
      pen.stroke();
      pen.setLineDash([]);
      pen.fillStyle = style("--s-text");
      pen.textAlign = "left";
      pen.fillText(CURSORS[k], x + 3, 12);
    });
  }
  // A value came as an integer of 16 bits: what is less than one of its steps is 0.
  function settled(trace, integer) {
    const value = trace.low + (integer + trace.offset) * trace.step;
    return Math.abs(value) < 0.51 * trace.step && trace.high > trace.low ? 0 : value;
  }
  function valueAt(trace, t) {
    let first = 0;
    let start = trace.from;
    for (const [k, at] of trace.breaks) if (at <= t) [first, start] = [k, at];
    const k = first + Math.round((t - start) / trace.every);
    if (k < 0 || k >= trace.count) return null;
    return settled(trace, 0.5 * (trace.lows[k] + trace.highs[k]));
  }
  const number = (value) => (value === null ? "—" : Number(value.toPrecision(5)).toString());
  function readout() {
    const body = document.querySelector(".studio-readout tbody");
    if (!body) return;
    const [a, b] = scope.cursors;
    const rows = data.channels.map((channel, k) => {
      const trace = data.traces.find((one) => one.channel === k);
      const last = trace && trace.count ? settled(trace, trace.highs[trace.count - 1]) : null;
      const at = (t) => (t === null || !trace ? null : valueAt(trace, t));
      const [va, vb] = [at(a), at(b)];
      return [channel, number(last), number(va), number(vb), number(va === null || vb === null ? null : vb - va)];
    });
    const colours = COLOURS[isDark() ? "dark" : "light"];
    const html = rows.map(([channel, ...cells], k) =>
      `<tr><th scope="row"><svg width="26" height="8" aria-hidden="true"><line x1="0" x2="26" y1="4" y2="4" stroke="${colours[k]}" ` +
      `stroke-width="3" stroke-dasharray="${DASHES[k].join(" ")}"/></svg> ${escape(channel.name)}</th>` +
      `${cells.map((one) => `<td>${one}</td>`).join("")}<td class="unit">${escape(channel.unit)}</td></tr>`).join("");
    const times = a === null && b === null ? "" :
      `<tr><th scope="row">t</th><td></td><td>${number(a)}</td><td>${number(b)}</td>` +
      `<td>${number(a === null || b === null ? null : b - a)}</td><td class="unit">s</td></tr>`;
    if (body.dataset.html !== html + times) {
      body.dataset.html = html + times;
      body.innerHTML = html + times;
    }
  }
  function escape(text) {
    return text.replace(/[&<>"]/g, (one) => ({ "&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;" })[one]);
  }

  scope.toggle = () => {
    const off = scope.cursors[0] === null;
    const span = data ? data.to - data.from : 1;
    scope.cursors = off ? [data.from + 0.25 * span, data.from + 0.75 * span] : [null, null];
    told();
    redraw();
  };
  function told() {
    emitEvent("scope_cursors", scope.cursors);
  }
  function place(event) {
    const t = xToTime(event.offsetX, box.clientWidth);
    scope.cursors[scope.active] = Math.min(Math.max(t, data.from), data.to);
    redraw();
  }
  function listen() {
    let drags = false;
    canvas.addEventListener("pointerdown", (event) => {
      if (scope.cursors[0] === null || !data) return;
      const t = xToTime(event.offsetX, box.clientWidth);
      scope.active = Math.abs(scope.cursors[1] - t) < Math.abs(scope.cursors[0] - t) ? 1 : 0;
      drags = true;
      canvas.setPointerCapture(event.pointerId);
      place(event);
    });
    canvas.addEventListener("pointermove", (event) => drags && place(event));
    canvas.addEventListener("pointerup", () => {
      if (drags) told();
      drags = false;
    });
    canvas.addEventListener("keydown", (event) => {
      const way = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      if (event.key === "c") scope.toggle();
      else if ((event.key === "a" || event.key === "b") && scope.cursors[0] !== null) scope.active = event.key === "b" ? 1 : 0;
      else if (way && scope.cursors[0] !== null && data) {
        event.preventDefault();
        const step = ((data.to - data.from) / 200) * (event.shiftKey ? 10 : 1);
        const t = scope.cursors[scope.active] + way * step;
        scope.cursors[scope.active] = Math.min(Math.max(t, data.from), data.to);
        told();
      }
      redraw();
    });
  }
})();
