"use strict"
// Shared by the local pages: elements, the coordinate frame and grid of a pad, and the messages of the server.
const SIDE = 480, MARGIN = 36, SVG = "http://www.w3.org/2000/svg"
const byId = id => document.getElementById(id)

// Content is set as attributes and text, never as markup.
function svgElement(name, attributes, text) {
  const element = document.createElementNS(SVG, name)
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value)
  if (text !== undefined) element.textContent = text
  return element
}
function htmlElement(name, className, text) {
  const element = document.createElement(name)
  element.className = className
  element.textContent = text
  return element
}

// The pad seen from above as it lies; with its tracks up it is mirrored, so that x points to the left.
function frame(view) {
  const scale = (SIDE - 2 * MARGIN) / (2 * Math.max(...view.half_mm)), right = view.mirrored ? -scale : scale
  return {
    scale,
    x: mm => SIDE / 2 + (mm - view.centre_mm[0]) * right,
    y: mm => SIDE / 2 - (mm - view.centre_mm[1]) * scale,
  }
}

function gridElements(view) {
  const {scale, x, y} = frame(view), [cx, cy] = view.centre_mm, [halfWidth, halfHeight] = view.half_mm
  const left = x(cx) - halfWidth * scale, labelY = y(cy - halfHeight) + MARGIN - 14, elements = []
  const half = Math.max(halfWidth, halfHeight), decade = 10 ** Math.floor(Math.log10(half))
  const step = decade / (half / decade < 3 ? 2 : 1)
  for (let mm = Math.ceil((cx - halfWidth) / step) * step; mm <= cx + halfWidth; mm += step) {
    elements.push(svgElement("line", {class: "grid", x1: x(mm), x2: x(mm), y1: y(cy - halfHeight), y2: y(cy + halfHeight)}))
    elements.push(svgElement("text", {x: x(mm), y: labelY, "text-anchor": "middle"}, +mm.toFixed(3)))
  }
  for (let mm = Math.ceil((cy - halfHeight) / step) * step; mm <= cy + halfHeight; mm += step) {
    elements.push(svgElement("line", {class: "grid", x1: x(cx - halfWidth), x2: x(cx + halfWidth), y1: y(mm), y2: y(mm)}))
    elements.push(svgElement("text", {x: left - 5, y: y(mm) + 4, "text-anchor": "end"}, +mm.toFixed(3)))
  }
  elements.push(svgElement("text", {x: left + 2 * halfWidth * scale + MARGIN - 8, y: labelY, "text-anchor": "end"}, "mm"))
  elements.push(svgElement("rect", {
    class: "grid edge", x: left, y: y(cy + halfHeight), width: 2 * halfWidth * scale, height: 2 * halfHeight * scale,
  }))
  return elements
}

// Call `show` with each message, which contains everything that the page shows.
function subscribe(show) {
  let ended = false
  const source = new EventSource("/events" + location.search)
  source.onmessage = message => {
    const view = JSON.parse(message.data)
    ended = Boolean(view.ended)
    show(view)
  }
  source.onerror = () => {
    if (ended) return
    byId("link").className = "disconnected"
    byId("link").textContent = "connection lost, trying again"
  }
}
