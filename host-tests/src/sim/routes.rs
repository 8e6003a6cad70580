//! What the routes of a bridge tell of its buses and units.

use jointbus_mcu_bridge::board::{Port, Protocol, Route, Target, Topology};

/// The routes to a bus.
fn to_bus(network: &Topology, port: Port) -> impl Iterator<Item = &Route> {
    network.routes.iter().filter(move |row| row.is_used() && row.target == Target::Bus(port))
}

/// The same, to be changed.
pub(super) fn to_bus_mut(network: &mut Topology, port: Port) -> impl Iterator<Item = &mut Route> {
    network.routes.iter_mut().filter(move |row| row.is_used() && row.target == Target::Bus(port))
}

/// What a bus speaks; `None` where no route leads to it.
pub(super) fn protocol(network: &Topology, port: Port) -> Option<Protocol> {
    to_bus(network, port).next().map(|row| row.protocol)
}

/// Whether a bus speaks NST.
pub(super) fn speaks_nst(network: &Topology, port: Port) -> bool {
    protocol(network, port).is_some_and(Protocol::is_nst)
}

/// Whether a bus speaks Modbus.
pub(super) fn speaks_modbus(network: &Topology, port: Port) -> bool {
    protocol(network, port).is_some_and(|protocol| !protocol.is_nst())
}

/// The unit that the host sees of a device on a bus.
pub(super) fn unit_at(network: &Topology, port: Port, address: u8) -> Option<u8> {
    to_bus(network, port).find_map(|row| {
        let unit = row.first_unit.wrapping_add(address.wrapping_sub(row.first_address));
        row.serves(unit).then_some(unit)
    })
}

/// The bus of a unit, if it is on one.
pub(super) fn port_of(network: &Topology, unit: u8) -> Option<Port> {
    network.route(unit).and_then(|(_, row)| row.target.port())
}

/// Whether the host speaks NST to a unit.
pub(super) fn is_nst(network: &Topology, unit: u8) -> bool {
    network.route(unit).is_some_and(|(_, row)| row.protocol.is_nst())
}
