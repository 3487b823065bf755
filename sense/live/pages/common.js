"use strict"
// What the pages of a pad share: elements, the pad's frame and grid, the fibres' bars, and the news of the server.
const SIDE = 480, MARGIN = 36, SVG = "http://www.w3.org/2000/svg"
const byId = id => document.getElementById(id)

// Whatever is shown comes in as attributes and text, never as markup.
function drawn(name, attributes, text) {
  const element = document.createElementNS(SVG, name)
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value)
  if (text !== undefined) element.textContent = text
  return element
}
function made(name, className, text) {
  const element = document.createElement(name)
  element.className = className
  element.textContent = text
  return element
}

// Seen from above as the pad lies: with its tracks up, mirrored, x runs to the left.
function frame(view) {
  const scale = (SIDE - 2 * MARGIN) / (2 * Math.max(...view.half_mm)), right = view.mirrored ? -scale : scale
  return {
    scale,
    x: mm => SIDE / 2 + (mm - view.middle_mm[0]) * right,
    y: mm => SIDE / 2 - (mm - view.middle_mm[1]) * scale,
  }
}

function gridParts(view) {
  const {scale, x, y} = frame(view), [cx, cy] = view.middle_mm, [wide, high] = view.half_mm, half = Math.max(wide, high)
  const left = x(cx) - wide * scale, below = y(cy - high) + MARGIN - 14, parts = []
  const step = 10 ** Math.floor(Math.log10(half)) / (half / 10 ** Math.floor(Math.log10(half)) < 3 ? 2 : 1)
  for (let at = Math.ceil((cx - wide) / step) * step; at <= cx + wide; at += step) {
    parts.push(drawn("line", {class: "grid", x1: x(at), x2: x(at), y1: y(cy - high), y2: y(cy + high)}))
    parts.push(drawn("text", {x: x(at), y: below, "text-anchor": "middle"}, +at.toFixed(3)))
  }
  for (let at = Math.ceil((cy - high) / step) * step; at <= cy + high; at += step) {
    parts.push(drawn("line", {class: "grid", x1: x(cx - wide), x2: x(cx + wide), y1: y(at), y2: y(at)}))
    parts.push(drawn("text", {x: left - 5, y: y(at) + 4, "text-anchor": "end"}, +at.toFixed(3)))
  }
  parts.push(drawn("text", {x: left + 2 * wide * scale + MARGIN - 8, y: below, "text-anchor": "end"}, "mm"))
  parts.push(drawn("rect", {class: "grid edge", x: left, y: y(cy + high), width: 2 * wide * scale, height: 2 * high * scale}))
  return parts
}

// Earlier presses fade.
function trailParts(view, before) {
  const {x, y} = frame(view)
  return before.map((press, index) => drawn("circle", {
    class: "trail", cx: x(press.x_mm), cy: y(press.y_mm), r: 4, "fill-opacity": (index + 1) / (before.length + 1) * .8,
  }))
}

function tellFibres(view) {
  byId("fibres").replaceChildren(...view.fibres.map((fibre, index) => {
    const bad = !["", "sound", "unwatched"].includes(fibre.state)
    const row = made("div", `fibre ${bad ? "bad" : fibre.state}`, "")
    const bar = drawn("svg", {class: "bar", viewBox: "-1 0 2 1", preserveAspectRatio: "none", "aria-hidden": "true"})
    const swing = Math.max(-1, Math.min(1, fibre.swing ?? 0))
    bar.append(drawn("rect", {class: "back", x: -1, y: 0, width: 2, height: 1, "vector-effect": "non-scaling-stroke"}))
    bar.append(drawn("rect", {x: Math.min(0, swing), y: .1, width: Math.abs(swing), height: .8}))
    bar.append(drawn("line", {x1: 0, x2: 0, y1: 0, y2: 1, "vector-effect": "non-scaling-stroke"}))
    row.append(made("span", "", `fibre ${index + 1}`), bar, made("span", "state", fibre.state))
    return row
  }))
}

// Every message is the whole of what is to be shown.
function follow(show) {
  let ended = false
  const source = new EventSource("/events")
  source.onmessage = message => {
    const view = JSON.parse(message.data)
    ended = Boolean(view.ended)
    show(view)
  }
  source.onerror = () => {
    if (ended) return
    byId("link").className = "lost"
    byId("link").textContent = "connection lost, trying again"
  }
}
