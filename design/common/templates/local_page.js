"use strict"
// What the pages of a pad share: elements, the pad's frame and grid, and the news of the server.
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

// Every message is the whole of what is to be shown.
function follow(show) {
  let ended = false
  const source = new EventSource("/events" + location.search)
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
