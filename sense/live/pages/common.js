// Parts that live.html and hand.html share: earlier presses, the older the fainter, and a bar for each fibre.
function trailElements(view, before) {
  const {x, y} = frame(view)
  return before.map((press, index) => svgElement("circle", {
    class: "trail", cx: x(press.x_mm), cy: y(press.y_mm), r: 4, "fill-opacity": (index + 1) / (before.length + 1) * .8,
  }))
}

function showFibres(view) {
  byId("fibres").replaceChildren(...view.fibres.map((fibre, index) => {
    const bad = !["", "sound", "unmonitored"].includes(fibre.state)
    const row = htmlElement("div", `fibre ${bad ? "bad" : fibre.state}`, "")
    const bar = svgElement("svg", {class: "bar", viewBox: "-1 0 2 1", preserveAspectRatio: "none", "aria-hidden": "true"})
    const swing = Math.max(-1, Math.min(1, fibre.swing ?? 0))
    bar.append(svgElement("rect", {class: "back", x: -1, y: 0, width: 2, height: 1, "vector-effect": "non-scaling-stroke"}))
    bar.append(svgElement("rect", {x: Math.min(0, swing), y: .1, width: Math.abs(swing), height: .8}))
    bar.append(svgElement("line", {x1: 0, x2: 0, y1: 0, y2: 1, "vector-effect": "non-scaling-stroke"}))
    row.append(htmlElement("span", "", `fibre ${index + 1}`), bar, htmlElement("span", "state", fibre.state))
    return row
  }))
}
