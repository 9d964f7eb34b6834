// The simulation of a report: the step of the law (`law`, made by exports.javascript) beside the
// data, redrawn as coefficients change. `shown` holds the data and the coefficients.
(() => {
"use strict";
const WIDTH = 900, HEIGHT = 220, LEFT = 62, RIGHT = 12, TOP = 10, BOTTOM = 30;
const box = document.getElementById("simulation");
const values = shown.coefficients.slice();
const dim = shown.start.length / 2;

// Momenta are linear in velocities: p of given v by the velocities of unit momenta.
function momenta(q, v, u, p) {
    const at = (m) => law.velocity([...q, ...m], u, p);
    const none = at(new Array(dim).fill(0));
    const rows = [];
    for (let i = 0; i < dim; i++) rows.push([...new Array(dim).fill(0), v[i] - none[i]]);
    for (let k = 0; k < dim; k++) {
        const unit = new Array(dim).fill(0);
        unit[k] = 1;
        const moved = at(unit);
        for (let i = 0; i < dim; i++) rows[i][k] = moved[i] - none[i];
    }
    for (let k = 0; k < dim; k++) {  // Gauss and Jordan, with the largest pivot
        let best = k;
        for (let i = k; i < dim; i++)
            if (Math.abs(rows[i][k]) > Math.abs(rows[best][k])) best = i;
        [rows[k], rows[best]] = [rows[best], rows[k]];
        for (let i = 0; i < dim; i++) {
            if (i === k) continue;
            const by = rows[i][k] / rows[k][k];
            for (let j = k; j <= dim; j++) rows[i][j] -= by * rows[k][j];
        }
    }
    return rows.map((row, k) => row[dim] / row[k]);
}

function simulated() {
    const first = shown.inputs.length ? shown.inputs[0] : shown.parameters;
    const q = shown.start.slice(0, dim), v = shown.start.slice(dim);
    let z = [...q, ...momenta(q, v, first, values)];
    const found = [z.slice(0, dim)];
    for (let k = 1; k < shown.t.length; k++) {
        const u = shown.inputs.length ? shown.inputs[k - 1] : shown.parameters;
        try { z = law.step(z, shown.t[k] - shown.t[k - 1], u, values); }
        catch (error) { z = z.map(() => NaN); }
        found.push(z.slice(0, dim));
    }
    return found;
}

const low = shown.t[0], high = shown.t[shown.t.length - 1];
const x = (t) => LEFT + (WIDTH - LEFT - RIGHT) * (t - low) / (high - low);

function made(name, attributes, parent) {
    const node = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const key in attributes) node.setAttribute(key, attributes[key]);
    parent.appendChild(node);
    return node;
}

function ticks(from, to) {
    const rough = (to - from) / 5, power = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].map((n) => n * power).find((n) => n >= rough);
    const found = [];
    for (let n = Math.ceil(from / step); n * step <= to; n++) found.push(n * step);
    return found;
}

const panels = shown.channels.map((channel) => {
    const seen = channel.y.filter((value) => value !== null);
    const least = Math.min(...seen), most = Math.max(...seen), more = 0.25 * (most - least) || 1;
    const y = (value) =>
        TOP + (HEIGHT - TOP - BOTTOM) * (most + more - value) / (most - least + 2 * more);
    const svg = made("svg", {viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img"}, box);
    const clip = made("clipPath", {id: `clip-${channel.name}`}, svg);
    made("rect", {x: LEFT, y: TOP, width: WIDTH - LEFT - RIGHT, height: HEIGHT - TOP - BOTTOM}, clip);
    for (const at of ticks(least - more, most + more)) {
        made("line", {x1: LEFT, x2: WIDTH - RIGHT, y1: y(at), y2: y(at), stroke: "#ddd"}, svg);
        made("text", {x: LEFT - 6, y: y(at) + 4, "text-anchor": "end"}, svg).textContent =
            String(Number(at.toPrecision(6)));
    }
    for (const at of ticks(low, high))
        made("text", {x: x(at), y: HEIGHT - 12, "text-anchor": "middle"}, svg).textContent =
            String(Number(at.toPrecision(6)));
    made("text", {x: WIDTH - RIGHT, y: HEIGHT - 4, "text-anchor": "end"}, svg).textContent = "t [s]";
    made("text", {x: 12, y: HEIGHT / 2, "text-anchor": "middle",
        transform: `rotate(-90 12 ${HEIGHT / 2})`}, svg).textContent = channel.label;
    const inside = made("g", {"clip-path": `url(#clip-${channel.name})`}, svg);
    channel.y.forEach((value, k) => {  // circles: Chromium draws no dots of paths without a length
        if (value !== null) made("circle", {cx: x(shown.t[k]), cy: y(value), r: 1.5, fill: "#888"}, inside);
    });
    const curve = made("path", {fill: "none", stroke: "#0072B2", "stroke-width": 1.8}, inside);
    return {channel, y, curve};
});

function draw() {
    const found = simulated();
    for (const {channel, y, curve} of panels) {
        let d = "", pen = "M";
        found.forEach((q, k) => {
            const value = q[channel.place] / channel.factor + channel.turn;
            if (!Number.isFinite(value)) { pen = "M"; return; }
            d += `${pen}${x(shown.t[k]).toFixed(1)} ${y(value).toFixed(1)}`;
            pen = "L";
        });
        curve.setAttribute("d", d);
    }
}

const sliders = [];
const list = document.getElementById("sliders");
shown.sliders.forEach((slider) => {
    const row = document.createElement("label");
    const name = document.createElement("span"), input = document.createElement("input");
    const number = document.createElement("output");
    name.textContent = slider.label;
    Object.assign(input, {type: "range", min: slider.low, max: slider.high, step: "any"});
    const show = () => { number.textContent = Number(values[slider.place]).toPrecision(5); };
    input.addEventListener("input", () => {
        values[slider.place] = Number(input.value);
        show();
        draw();
    });
    const reset = () => {
        values[slider.place] = shown.coefficients[slider.place];
        input.value = values[slider.place];
        show();
    };
    row.append(name, input, number);
    list.append(row);
    sliders.push(reset);
    reset();
});
document.getElementById("reset").addEventListener("click", () => {
    sliders.forEach((reset) => reset());
    draw();
});
draw();
})();
