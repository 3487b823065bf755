// Draw the pad as SVG. Elements are updated in place where possible: replacing one would lose focus or pointer capture.
const MAX_OPACITY = 0.8 // opacity at the top of the colour scale
let layers = {key: "", cells: [], fibres: [], knots: []}

function layerKey(view) {
  return JSON.stringify([view.session, view.positions_mm.length, view.fibres.map(fibre => fibre.knots.length)])
}

function setChildren(group, parts) { byId(group).replaceChildren(...parts) }

// Create all elements, for another pad or after a knot was added or removed.
function build(view, handlers) {
  const {scale, x, y} = frame(view), [wide, high] = view.cell_mm
  layers = {key: layerKey(view), cells: [], fibres: [], knots: []}
  layers.cells = view.positions_mm.map(([px, py]) => svgElement("rect", {
    x: x(px - wide / 2), y: y(py + high / 2), width: wide * scale, height: high * scale,
  }))
  setChildren("map", layers.cells)
  const [left, low, right, top] = view.sensed_mm
  setChildren("grid", [...gridElements(view), svgElement("rect", {
    class: "sensed", x: x(left), y: y(top), width: (right - left) * scale, height: (top - low) * scale,
  })])
  setChildren("keep-outs", view.keep_out_mm.map(corners => svgElement("polygon", {
    class: "keep-out", points: corners.map(([px, py]) => `${x(px)},${y(py)}`).join(" "),
  })))
  layers.fibres = view.fibres.map((fibre, index) => {
    const group = svgElement("g", {class: `f${fibre.family}`})
    const parts = ["halo", "path", "hit"].map(name => svgElement("path", {class: name}))
    const [sx, sy] = fibre.knots[0], horizontal = fibre.family === 0
    // horizontals are labelled inside the left edge, since the scale of y is outside
    const label = svgElement("text", {
      x: x(sx) + (horizontal ? 4 : 0), y: y(sy) + (horizontal ? -5 : 12), "text-anchor": horizontal ? "start" : "middle",
    }, index + 1)
    parts[2].addEventListener("pointerdown", () => handlers.select(index))
    parts[2].addEventListener("dblclick", event => handlers.add(index, event))
    group.append(...parts, label)
    return {group, parts}
  })
  // the deeper family lies below
  const isUpper = index => view.fibres[index].family !== view.deep_family
  const order = [...view.fibres.keys()].sort((a, b) => isUpper(a) - isUpper(b)) // stable
  setChildren("lines", order.map(index => layers.fibres[index].group))
  layers.knots = view.fibres.map((fibre, f) => fibre.knots.slice(1, -1).map((_, k) => {
    const knot = svgElement("g", {class: "knot", role: "button"})
    knot.append(svgElement("circle", {class: "grip", r: 13}), svgElement("circle", {class: "dot", r: 4}))
    knot.addEventListener("pointerdown", event => handlers.hold(f, k + 1, event))
    knot.addEventListener("focus", () => handlers.select(f, k + 1))
    return knot
  }))
  setChildren("knots", layers.knots.flat())
}

function update(view, selected, limit, nFailed) {
  const {x, y} = frame(view)
  view.ambiguity_map_mm[nFailed].forEach((value, index) => {
    layers.cells[index].setAttribute("fill-opacity", (Math.min(1, value / limit) * MAX_OPACITY).toFixed(3))
  })
  const broken = new Set(view.rules.flatMap(rule => rule.fibres))
  view.fibres.forEach((fibre, f) => {
    const points = fibre.spans.map(span => span.map(([px, py]) => `${x(px).toFixed(2)},${y(py).toFixed(2)}`))
    const curve = `M${points[0][0]}` + points.map(([, a, b, c]) => `C${a} ${b} ${c}`).join("")
    const {group, parts} = layers.fibres[f]
    for (const part of parts) part.setAttribute("d", curve)
    group.setAttribute("class", `f${fibre.family}${f === selected.fibre ? " selected" : ""}${broken.has(f + 1) ? " broken" : ""}`)
    layers.knots[f].forEach((knot, k) => {
      const [px, py] = fibre.knots[k + 1]
      knot.setAttribute("transform", `translate(${x(px)} ${y(py)})`)
      knot.setAttribute("aria-label", `fibre ${f + 1}, knot ${k + 1} of ${layers.knots[f].length}: x ${px.toFixed(2)}, y ${py.toFixed(2)} mm`)
      knot.setAttribute("tabindex", f === selected.fibre ? 0 : -1)
      knot.classList.toggle("selected", f === selected.fibre)
      knot.classList.toggle("active", f === selected.fibre && k + 1 === selected.knot)
    })
  })
  setChildren("violations", view.rules.filter(rule => rule.place_mm).map(rule => {
    const cx = x(rule.place_mm[0]), cy = y(rule.place_mm[1])
    return svgElement("path", {class: "violation", d: `M${cx - 6},${cy - 6}l12,12m0,-12l-12,12`})
  }))
}

// Return the position of a pointer event on the pad, mm.
function pointerPosition(view, event) {
  const {x, y} = frame(view), svg = byId("pad")
  const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse())
  return {x_mm: (at.x - x(0)) / (x(1) - x(0)), y_mm: (at.y - y(0)) / (y(1) - y(0))}
}
