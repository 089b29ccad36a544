// SPDX-License-Identifier: GPL-2.0-only
// One shared 802.11 channel in ns-3, for the comparison with protocol/radio.
//
// This program runs in its own process and links to ns-3, which is licensed under GPL-2; nothing of it is
// part of the installed package. It reads a case from standard input and writes what arrived to standard output.
//
// Input, one item a line:
//   NAME VALUE                        settings; each name as in Case below
//   station X Y Z                     position, m, in the order of their numbers
//   send TIME_NS SENDER RECEIVER BYTES   RECEIVER -1 is a broadcast; BYTES of the message
// Output, one item a line:
//   arrival SEND RECEIVER TIME_NS     SEND counts the input's sends from 0
//   count NAME VALUE                  transmissions, physical drops by reason, drops of queues, given up

#include "ns3/core-module.h"
#include "ns3/mobility-module.h"
#include "ns3/network-module.h"
#include "ns3/propagation-module.h"
#include "ns3/wifi-module.h"

#include <cstdint>
#include <iostream>
#include <map>
#include <sstream>
#include <string>
#include <vector>

using namespace ns3;

struct Send
{
    int64_t time_ns;
    uint32_t sender;
    int32_t receiver;
    uint32_t bytes;
};

struct Case
{
    std::string standard = "802.11a";
    std::string data_mode = "OfdmRate6Mbps";
    std::string control_mode = "OfdmRate6Mbps";
    double power_dbm = 16.0;
    double exponent = 3.0;
    double reference_loss_db = 46.6777;
    double sensitivity_dbm = -82.0;
    double preamble_snr_db = 4.0;
    double carrier_sense_dbm = -82.0;
    uint32_t queue = 100;
    uint32_t attempts = 7;
    uint32_t seed = 1;
    int64_t end_ns = 0;
    std::vector<Vector> stations;
    std::vector<Send> sends;
};

std::map<std::string, uint64_t> counts;

Case
ReadCase(std::istream& input)
{
    Case read;
    std::string line;
    while (std::getline(input, line))
    {
        std::istringstream words(line);
        std::string name;
        words >> name;
        if (name == "station")
        {
            Vector position;
            words >> position.x >> position.y >> position.z;
            read.stations.push_back(position);
        }
        else if (name == "send")
        {
            Send send;
            words >> send.time_ns >> send.sender >> send.receiver >> send.bytes;
            read.sends.push_back(send);
        }
        else if (name == "standard") { words >> read.standard; }
        else if (name == "data_mode") { words >> read.data_mode; }
        else if (name == "control_mode") { words >> read.control_mode; }
        else if (name == "power_dbm") { words >> read.power_dbm; }
        else if (name == "exponent") { words >> read.exponent; }
        else if (name == "reference_loss_db") { words >> read.reference_loss_db; }
        else if (name == "sensitivity_dbm") { words >> read.sensitivity_dbm; }
        else if (name == "preamble_snr_db") { words >> read.preamble_snr_db; }
        else if (name == "carrier_sense_dbm") { words >> read.carrier_sense_dbm; }
        else if (name == "queue") { words >> read.queue; }
        else if (name == "attempts") { words >> read.attempts; }
        else if (name == "seed") { words >> read.seed; }
        else if (name == "end_ns") { words >> read.end_ns; }
        else
        {
            std::cerr << "unknown line: " << line << std::endl;
            std::exit(2);
        }
        if (words.fail())
        {
            std::cerr << "malformed line: " << line << std::endl;
            std::exit(2);
        }
    }
    return read;
}

// A message starts with the number of its send, which the receiver reads.
Ptr<Packet>
MessageOf(uint32_t number, uint32_t bytes)
{
    std::vector<uint8_t> content(bytes, 0);
    for (int byte = 0; byte < 4; ++byte)
    {
        content[byte] = static_cast<uint8_t>(number >> (8 * byte));
    }
    return Create<Packet>(content.data(), bytes);
}

uint32_t
NumberOf(Ptr<const Packet> packet)
{
    uint8_t content[4];
    packet->CopyData(content, 4);
    return content[0] | (content[1] << 8) | (content[2] << 16) | (static_cast<uint32_t>(content[3]) << 24);
}

bool
Received(Ptr<NetDevice> device, Ptr<const Packet> packet, uint16_t, const Address&)
{
    std::cout << "arrival " << NumberOf(packet) << ' ' << device->GetNode()->GetId() << ' '
              << Simulator::Now().GetNanoSeconds() << '\n';
    return true;
}

void
Dropped(Ptr<const Packet>, WifiPhyRxfailureReason reason)
{
    std::ostringstream name;
    name << "drop_" << reason;
    ++counts[name.str()];
}

void
Transmitted(Ptr<const Packet>, double)
{
    ++counts["transmissions"];
}

void
Refused(Ptr<const Packet>)
{
    ++counts["mac_drop"];
}

void
GivenUp(WifiMacDropReason reason, Ptr<const WifiMpdu>)
{
    if (reason == WIFI_MAC_DROP_REACHED_RETRY_LIMIT)
    {
        ++counts["given_up"];
    }
    else if (reason == WIFI_MAC_DROP_FAILED_ENQUEUE)
    {
        ++counts["queue_drops"];
    }
}

int
main()
{
    std::ios::sync_with_stdio(false);
    const Case given = ReadCase(std::cin);
    RngSeedManager::SetSeed(given.seed);

    Config::SetDefault("ns3::WifiMacQueue::MaxSize", QueueSizeValue(QueueSize(PACKETS, given.queue)));
    Config::SetDefault("ns3::WifiMacQueue::MaxDelay", TimeValue(Seconds(1000)));
    Config::SetDefault("ns3::WifiMac::FrameRetryLimit", UintegerValue(given.attempts));
    Config::SetDefault("ns3::ThresholdPreambleDetectionModel::Threshold", DoubleValue(given.preamble_snr_db));
    Config::SetDefault("ns3::ThresholdPreambleDetectionModel::MinimumRssi", DoubleValue(given.sensitivity_dbm));

    NodeContainer nodes;
    nodes.Create(given.stations.size());

    auto positions = CreateObject<ListPositionAllocator>();
    for (const Vector& station : given.stations)
    {
        positions->Add(station);
    }
    MobilityHelper mobility;
    mobility.SetPositionAllocator(positions);
    mobility.SetMobilityModel("ns3::ConstantPositionMobilityModel");
    mobility.Install(nodes);

    auto loss = CreateObject<LogDistancePropagationLossModel>();
    loss->SetPathLossExponent(given.exponent);
    loss->SetReference(1.0, given.reference_loss_db);
    auto channel = CreateObject<YansWifiChannel>();
    channel->SetPropagationLossModel(loss);
    channel->SetPropagationDelayModel(CreateObject<ConstantSpeedPropagationDelayModel>());

    YansWifiPhyHelper phy;
    phy.SetChannel(channel);
    phy.Set("TxPowerStart", DoubleValue(given.power_dbm));
    phy.Set("TxPowerEnd", DoubleValue(given.power_dbm));
    // The threshold for signals of the own standard; energy of others does not occur here.
    phy.Set("CcaSensitivity", DoubleValue(given.carrier_sense_dbm));

    WifiHelper wifi;
    wifi.SetStandard(given.standard == "802.11b" ? WIFI_STANDARD_80211b : WIFI_STANDARD_80211a);
    wifi.SetRemoteStationManager("ns3::ConstantRateWifiManager",
                                 "DataMode", StringValue(given.data_mode),
                                 "ControlMode", StringValue(given.control_mode),
                                 "NonUnicastMode", StringValue(given.data_mode));
    WifiMacHelper mac;
    mac.SetType("ns3::AdhocWifiMac");
    NetDeviceContainer devices = wifi.Install(phy, mac, nodes);
    WifiHelper::AssignStreams(devices, 1);

    for (uint32_t station = 0; station < devices.GetN(); ++station)
    {
        auto device = DynamicCast<WifiNetDevice>(devices.Get(station));
        device->SetReceiveCallback(MakeCallback(&Received));
        device->GetPhy()->TraceConnectWithoutContext("PhyRxDrop", MakeCallback(&Dropped));
        device->GetPhy()->TraceConnectWithoutContext("PhyTxBegin", MakeCallback(&Transmitted));
        device->GetMac()->TraceConnectWithoutContext("MacTxDrop", MakeCallback(&Refused));
        device->GetMac()->TraceConnectWithoutContext("DroppedMpdu", MakeCallback(&GivenUp));
    }

    for (uint32_t number = 0; number < given.sends.size(); ++number)
    {
        const Send& send = given.sends[number];
        Ptr<NetDevice> device = devices.Get(send.sender);
        const Address target = send.receiver < 0 ? device->GetBroadcast() : devices.Get(send.receiver)->GetAddress();
        Simulator::Schedule(NanoSeconds(send.time_ns), [device, target, number, bytes = send.bytes]() {
            device->Send(MessageOf(number, bytes), target, 0x0800);
        });
    }
    Simulator::Stop(NanoSeconds(given.end_ns));
    Simulator::Run();
    Simulator::Destroy();

    for (const auto& [name, value] : counts)
    {
        std::cout << "count " << name << ' ' << value << '\n';
    }
    return 0;
}
